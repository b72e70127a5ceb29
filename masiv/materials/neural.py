"""The neural constitutive law: isotropic, frame indifferent, at rest at F = I, whatever its weights are.

Stress is a combination of the isotropic tensor basis of the left Cauchy-Green tensor, flow a relaxation of the elastic
strain at a rate; two small networks give the coefficients from three invariants of the strain. With positive moduli the
principal stresses are ordered as the principal stretches are (the Baker-Ericksen inequalities) and pressure opposes
compression. The flow is a rate, so the law does not depend on the substep: elastic bodies, viscous fluids, plasticity
and sand are relaxation times that depend on strain in different ways.

differs from MASIV and NCLaw: their networks see F^T F entry by entry (frame indifferent but not isotropic) and correct
F once a substep, which ties the law to the substep.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

import torch

from masiv.materials.law import BoundLaw, Law

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

STRAIN_SCALE = 0.02
LOG_MODULUS_RANGE = 6.0
LOG_RATE_RANGE = 14.0  # relaxation rates of e^-14 to e^14 per second


def strain_invariants(deformation_gradient: torch.Tensor) -> torch.Tensor:
    """(ln J, I1 - 3, I2 - 3) of the isochoric left Cauchy-Green tensor, (N, 3, 3) -> (N, 3)."""
    j = torch.linalg.det(deformation_gradient)
    c = deformation_gradient.mT @ deformation_gradient
    i1 = c.diagonal(dim1=1, dim2=2).sum(1)
    i2 = 0.5 * (i1**2 - (c * c).sum((1, 2)))
    return torch.stack([torch.log(j), i1 * j ** (-2 / 3) - 3, i2 * j ** (-4 / 3) - 3], dim=1)


class NeuralLaw(Law):
    """Two networks 3 -> width -> width -> coefficients, and two scales learnt as logarithms.

    The elastic network gives log moduli relative to the stress scale [Pa], the plastic one log relaxation rates [1/s]
    of strains relative to the flow strain: moving the two scales makes another stiffness and another yield strain of
    one kind.
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

    def moduli(self, invariants: torch.Tensor) -> torch.Tensor:
        """Coefficients (N, 4) [Pa] of ``masiv.kernels.tensor.neural_stress`` from invariants (N, 3)."""
        raw = self.elastic(self.features(invariants, STRAIN_SCALE))
        bounded = LOG_MODULUS_RANGE * torch.tanh(raw[:, :3] / LOG_MODULUS_RANGE)
        return torch.exp(self.log_stress_scale) * torch.cat([torch.exp(bounded), torch.tanh(raw[:, 3:])], dim=1)

    def flow_share(self, invariants: torch.Tensor, dt: float) -> torch.Tensor:
        """Shares (N, 2) of the isochoric and volumetric elastic strain that flow within dt [s]."""
        raw = self.plastic(self.features(invariants, torch.exp(self.log_flow_strain)))
        rate = torch.exp(LOG_RATE_RANGE * torch.tanh(raw / LOG_RATE_RANGE))
        return -torch.expm1(-dt * rate)

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

    def file_metadata(self) -> dict[str, str]:
        return {"kind": self.kind, "width": str(self.width)}


def _network(width: int, outputs: int, generator: torch.Generator) -> torch.nn.Sequential:
    layers = [torch.nn.Linear(3, width), torch.nn.Linear(width, width), torch.nn.Linear(width, outputs)]
    for layer in layers:
        torch.nn.init.xavier_uniform_(layer.weight, generator=generator)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(layers[0], torch.nn.GELU(), layers[1], torch.nn.GELU(), layers[2])


def _trace(a: torch.Tensor) -> torch.Tensor:
    return a.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]


def _deviator(a: torch.Tensor) -> torch.Tensor:
    return a - _trace(a) / 3 * torch.eye(3, dtype=a.dtype)


def _isochoric(f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    j = torch.linalg.det(f)[:, None, None]
    b = j ** (-2 / 3) * (f @ f.mT)
    return j, b, torch.linalg.inv(b), torch.eye(3, dtype=f.dtype)


@functools.lru_cache(maxsize=8)
def _neural_kernels(mpm):
    from masiv.kernels.neural import NeuralKernels

    return NeuralKernels(mpm)


class _BoundNeural(BoundLaw):
    """The networks in torch between two kernels: invariants out, coefficients in."""

    def __init__(self, law: NeuralLaw, mpm: MpmKernels, count: int, dt: float) -> None:
        self.law = law
        self.dt = dt
        self.kernels = _neural_kernels(mpm)
        self.dtype = law.log_stress_scale.dtype
        self.parameters = tuple(law.parameters())
        self.gradients = [torch.zeros_like(p) for p in self.parameters]
        self.trial_invariants = torch.empty(count, 3, dtype=self.dtype)
        self.invariants = torch.empty(count, 3, dtype=self.dtype)
        self.share_bar = torch.empty(count, 2, dtype=self.dtype)
        self.moduli_bar = torch.empty(count, 4, dtype=self.dtype)

    def forward(self, s: int, count: int) -> None:
        with torch.no_grad():
            self.kernels.trial_invariants(s, self.trial_invariants)
            self.kernels.flow(s, self.law.flow_share(self.trial_invariants, self.dt), self.invariants)
            self.kernels.elastic(s, self.law.moduli(self.invariants))

    def backward(self, s: int, count: int) -> None:
        k = self.kernels
        k.elastic_invariants(s, self.invariants)
        k.trial_invariants(s, self.trial_invariants)
        final = self.invariants.clone().requires_grad_()
        moduli = self.law.moduli(final)
        k.elastic_adjoint(s, moduli.detach(), self.moduli_bar)
        final_bar = self._through(moduli, final, self.moduli_bar)
        trial = self.trial_invariants.clone().requires_grad_()
        share = self.law.flow_share(trial, self.dt)
        k.flow_adjoint(s, share.detach(), final_bar, self.share_bar)
        k.trial_invariants_adjoint(s, self._through(share, trial, self.share_bar))

    def _through(self, output: torch.Tensor, invariants: torch.Tensor, bar: torch.Tensor) -> torch.Tensor:
        """Adjoint of the invariants; gradients of the weights are added up."""
        bars = torch.autograd.grad(output, (invariants, *self.parameters), bar, allow_unused=True)
        for total, part in zip(self.gradients, bars[1:], strict=True):
            if part is not None:
                total += part
        return bars[0]

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        return tuple(self.gradients)
