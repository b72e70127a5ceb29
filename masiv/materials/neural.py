"""The neural constitutive law: isotropic, frame indifferent and at rest at F = I for all weights.

Stress is a combination of the isotropic tensor basis of the left Cauchy-Green tensor, flow a relaxation of the elastic
strain at a rate; two small networks give the coefficients from three invariants of the strain. With positive moduli the
principal stresses are ordered as the principal stretches are (the Baker-Ericksen inequalities) and pressure opposes
compression. The flow is a rate, so the law does not depend on the substep: elastic bodies, viscous fluids, plasticity
and sand are relaxation times that depend on strain in different ways.

A rate that is evaluated at the strain before a substep overshoots if it rises steeply with the strain, as at a yield
stress: a larger strain would end as a smaller one. The motion then chatters a little, and its derivative grows by a
factor each substep. So the flow within a substep is bounded (``table.lipschitz_envelope``) such that a larger strain
never ends as a smaller one. The steepest law is perfect plasticity, whose derivative is zero.

differs from MASIV and NCLaw: their networks see F^T F entry by entry (frame indifferent but not isotropic) and correct
F once a substep, which ties the law to the substep.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from masiv.materials import table
from masiv.materials.law import BoundLaw, Law, SharedBoundLaw

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

STRAIN_SCALE = 0.02
"""Strain [1] beyond which the elastic features are logarithmic."""
LOG_MODULUS_RANGE, LOG_RATE_RANGE = 6.0, 14.0
"""Moduli are e^-6 to e^6 of the stress scale, relaxation rates e^-14 to e^14 per second."""
PRIOR_STRIDE = 5
"""``prior_distance`` takes every fifth node of the lattice: no count of the lattice is a multiple of 5."""


def strain_invariants(deformation_gradient: torch.Tensor) -> torch.Tensor:
    """(ln J, I1 - 3, I2 - 3) of the isochoric left Cauchy-Green tensor, (N, 3, 3) -> (N, 3)."""
    j = torch.linalg.det(deformation_gradient)
    c = deformation_gradient.mT @ deformation_gradient
    i1 = c.diagonal(dim1=1, dim2=2).sum(1)
    i2 = 0.5 * (i1**2 - (c * c).sum((1, 2)))
    return torch.stack([torch.log(j), i1 * j ** (-2 / 3) - 3, i2 * j ** (-4 / 3) - 3], dim=1)


class NeuralLaw(Law):
    """Two networks 3 -> width -> width -> coefficients, and four scales learnt as logarithms.

    The law interpolates values of the networks on a lattice of strain features (``masiv.materials.table``).

    The elastic network gives log moduli relative to the stress scale [Pa], the plastic one log relaxation rates [1/s]
    of strains relative to the flow strain. The scales change the stiffness, the ratio of bulk
    to shear modulus, the yield strain and the rate of flow, and keep the kind of material.
    """

    kind = "neural"

    def __init__(self, *, stress_scale: float = 1e4, width: int = 24, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.width = width
        self.elastic = _network(width, 4, generator)
        self.plastic = _network(width, 2, generator)
        self.log_stress_scale = torch.nn.Parameter(torch.tensor(math.log(stress_scale)))
        self.log_flow_strain = torch.nn.Parameter(torch.tensor(math.log(STRAIN_SCALE)))
        self.log_bulk_ratio = torch.nn.Parameter(torch.tensor(0.0))
        self.log_flow_rate = torch.nn.Parameter(torch.tensor(0.0))

    @classmethod
    def maxwell(
        cls, *, shear_modulus: float, bulk_modulus: float, relaxation_time: float, width: int = 24, seed: int = 0
    ) -> NeuralLaw:
        """A Maxwell fluid: moduli [Pa] and relaxation time [s] are the same at all strains.

        In motions that are slow compared with the relaxation time it is Newtonian, of viscosity shear modulus x
        relaxation time [Pa s].
        """
        law = cls.of_moduli(shear_modulus=shear_modulus, bulk_modulus=bulk_modulus, width=width, seed=seed)
        rate = LOG_RATE_RANGE * math.atanh(-math.log(relaxation_time) / LOG_RATE_RANGE)
        _set_constant(law.plastic, (rate, -2 * LOG_RATE_RANGE))
        return law

    @classmethod
    def of_moduli(cls, *, shear_modulus: float, bulk_modulus: float, width: int = 24, seed: int = 0) -> NeuralLaw:
        """A law whose moduli [Pa] are the same at all strains; its flow is random, from the seed."""
        law = cls(stress_scale=shear_modulus, width=width, seed=seed)
        bulk = LOG_MODULUS_RANGE * math.atanh(math.log(bulk_modulus / shear_modulus) / LOG_MODULUS_RANGE)
        _set_constant(
            law.elastic, (0.0, -2 * LOG_MODULUS_RANGE, bulk, 0.0)
        )  # g2: the smallest that the networks can give
        return law

    def scales(self) -> list[torch.nn.Parameter]:
        """Logarithms of stress scale, bulk ratio, flow strain and rate of the isochoric flow, each ()."""
        return [self.log_stress_scale, self.log_bulk_ratio, self.log_flow_strain, self.log_flow_rate]

    @staticmethod
    def features(invariants: torch.Tensor, strain: torch.Tensor | float) -> torch.Tensor:
        """Invariants (N, 3) -> network inputs (N, 3): volume, size of the shear, and its kind (tension or compression).

        Strains well below ``strain`` are seen linearly, those above logarithmically.
        """
        volume, first, second = invariants.unbind(1)
        square = strain**2
        size = torch.log1p(torch.relu(first + second) / square)
        sort = (second - first) / (first + second + square)
        return torch.stack([torch.asinh(volume / strain), 0.5 * size, sort], dim=1)

    def moduli_table(self) -> torch.Tensor:
        """ln g1, ln g2, ln kappa and coupling [Pa] at the nodes of ``masiv.materials.table``, (K, 4)."""
        return self.once("moduli", self._moduli_table)

    def _moduli_table(self) -> torch.Tensor:
        raw = self.elastic(table.nodes(self.log_stress_scale.dtype))
        shear, bulk = (LOG_MODULUS_RANGE * torch.tanh(part / LOG_MODULUS_RANGE) for part in raw[:, :3].split((2, 1), 1))
        coupling = torch.exp(self.log_stress_scale) * torch.tanh(raw[:, 3:])
        moduli = torch.cat([shear, bulk + self.log_bulk_ratio], dim=1)
        return torch.cat([self.log_stress_scale + moduli, coupling], dim=1)

    def rate_table(self) -> torch.Tensor:
        """Logarithms of the isochoric and volumetric relaxation rate [1/s] at the nodes, (K, 2)."""
        return self.once("rates", self._rate_table)

    def _rate_table(self) -> torch.Tensor:
        raw = self.plastic(table.nodes(self.log_stress_scale.dtype))
        isochoric, volumetric = raw.split(1, dim=1)
        moved = torch.cat([isochoric + self.log_flow_rate, volumetric], dim=1)
        return LOG_RATE_RANGE * torch.tanh(moved / LOG_RATE_RANGE)

    def flow_table(self, dt: float) -> torch.Tensor:
        """-ln of the shares of isochoric and volumetric strain that a substep of dt [s] keeps, at the nodes, (K, 2)."""
        return self.once(("flow", dt), lambda: table.lipschitz_envelope(dt * torch.exp(self.rate_table())))

    def moduli(self, invariants: torch.Tensor) -> torch.Tensor:
        """Coefficients (N, 4) [Pa] of ``masiv.kernels.isotropic.stress`` from invariants (N, 3)."""
        value = table.interpolate(self.moduli_table(), self.features(invariants, STRAIN_SCALE))
        return torch.cat([torch.exp(value[:, :3]), value[:, 3:]], dim=1)

    def flow(self, invariants: torch.Tensor, dt: float) -> torch.Tensor:
        """-ln (N, 2) of the shares of isochoric and volumetric elastic strain that are left after dt [s]."""
        features = self.features(invariants, torch.exp(self.log_flow_strain))
        return table.interpolate(self.flow_table(dt), features)

    def flow_share(self, invariants: torch.Tensor, dt: float) -> torch.Tensor:
        """Shares (N, 2) of the isochoric and volumetric elastic strain that flow within dt [s]."""
        return -torch.expm1(-self.flow(invariants, dt))

    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        share = self.flow_share(strain_invariants(trial_gradient), dt)
        j, b, b_inverse, eye = _isochoric(trial_gradient)
        q = 0.5 * (_trace(b) + _trace(b_inverse)) - 3
        half = (0.125 * share[:, 0, None, None] / torch.sqrt(1 + q / 3)) * _deviator(b - b_inverse)
        m = torch.linalg.solve(eye + half, eye - half)
        scale = torch.linalg.det(m) ** (-1 / 3) * j[:, 0, 0] ** (-share[:, 1] / 3)
        return scale[:, None, None] * (m @ trial_gradient)

    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        g1, g2, kappa, coupling = self.moduli(strain_invariants(deformation_gradient))[:, :, None, None].unbind(1)
        j, b, b_inverse, eye = _isochoric(deformation_gradient)
        pressure = 0.5 * kappa * (j - 1 / j) + coupling * (_trace(b) - 3)
        return g1 * _deviator(b) - g2 * _deviator(b_inverse) + pressure * eye

    def prior_distance(self, other: NeuralLaw) -> torch.Tensor:
        """Mean square difference () of the networks' outputs (log moduli relative to the stress scale, coupling, log
        rates) from those of ``other`` over the lattice of strain features; the scales do not count."""
        nodes = table.nodes(self.log_stress_scale.dtype)[::PRIOR_STRIDE]
        with torch.no_grad():
            were = other.elastic(nodes), other.plastic(nodes)
        now = self.elastic(nodes), self.plastic(nodes)
        return sum(((a - b).square().mean() for a, b in zip(now, were, strict=True)), torch.zeros(()))

    def wave_modulus(self) -> float:
        with torch.no_grad():
            g1, g2, kappa, _ = self.moduli(torch.zeros(1, 3, dtype=self.log_stress_scale.dtype))[0].tolist()
        return kappa + 4.0 / 3.0 * (g1 + g2)

    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        return _BoundNeural(self, kernels, count, dt)

    def description(self) -> dict[str, Any]:
        with torch.no_grad():
            g1, g2, kappa, _ = self.moduli(torch.zeros(1, 3, dtype=self.log_stress_scale.dtype))[0].tolist()
        return {
            "kind": self.kind,
            "width": self.width,
            "parameters": {
                "shear_modulus_at_rest": {"value": g1 + g2, "unit": "Pa"},
                "bulk_modulus_at_rest": {"value": kappa, "unit": "Pa"},
            },
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Also of a law from a file without bulk ratio and flow rate, which are 1 then."""
        ones = {name: torch.zeros(()) for name in ("log_bulk_ratio", "log_flow_rate")}
        return super().load_state_dict({**ones, **state_dict}, strict, assign)

    def file_metadata(self) -> dict[str, str]:
        return {"kind": self.kind, "width": str(self.width)}


def _network(width: int, outputs: int, generator: torch.Generator) -> torch.nn.Sequential:
    layers = [torch.nn.Linear(3, width), torch.nn.Linear(width, width), torch.nn.Linear(width, outputs)]
    for layer in layers:
        torch.nn.init.xavier_uniform_(layer.weight, generator=generator)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(layers[0], torch.nn.GELU(), layers[1], torch.nn.GELU(), layers[2])


def output_layer(network: torch.nn.Sequential) -> torch.nn.Linear:
    """The last layer of a network of a ``NeuralLaw``."""
    layer = network[-1]
    assert isinstance(layer, torch.nn.Linear)
    return layer


def _set_constant(network: torch.nn.Sequential, values: tuple[float, ...]) -> None:
    """Let ``network`` return ``values`` for every input."""
    with torch.no_grad():
        output_layer(network).weight.zero_()
        output_layer(network).bias.copy_(torch.tensor(values))


def _trace(a: torch.Tensor) -> torch.Tensor:
    return a.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]


def _deviator(a: torch.Tensor) -> torch.Tensor:
    return a - _trace(a) / 3 * torch.eye(3, dtype=a.dtype)


def _isochoric(f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    j = torch.linalg.det(f)[:, None, None]
    b = j ** (-2 / 3) * (f @ f.mT)
    return j, b, torch.linalg.inv(b), torch.eye(3, dtype=f.dtype)


class _BoundNeural(SharedBoundLaw):
    """The networks run once here; kernels interpolate their tables."""

    def __init__(self, law: NeuralLaw, mpm: MpmKernels, count: int, dt: float) -> None:
        from masiv.kernels.neural import NeuralKernels

        self.kernels = mpm.attached(NeuralKernels, lambda: NeuralKernels(mpm))
        self.count = count
        self.parameters = tuple(law.parameters())
        with torch.enable_grad():
            self.tables = (law.moduli_table(), law.flow_table(dt), torch.exp(law.log_flow_strain))
        self.dtype = mpm.torch_dtype
        self._own()

    def write(self) -> None:
        moduli, flows = (t.detach().to(self.dtype).contiguous() for t in self.tables[:2])
        strains = torch.tensor([STRAIN_SCALE, float(self.tables[2].detach())], dtype=self.dtype)
        self.kernels.write_tables(moduli, flows, strains, self.count)

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        bars = [torch.empty(len(self.tables[0]), width, dtype=self.dtype) for width in (4, 2)]
        strain = torch.empty(self.count, dtype=self.dtype)
        self.kernels.read_bars(*bars, strain)
        bars = [bar.to(t.dtype) for bar, t in zip([*bars, strain.double().sum()], self.tables, strict=True)]
        return torch.autograd.grad(self.tables, self.parameters, bars)
