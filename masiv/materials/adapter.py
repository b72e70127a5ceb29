"""A classical law with a small learnt correction of low rank (the idea of NeuMA, Cao et al. 2024).

The classical law is written in invariants of the elastic strain, as the neural law is: stress in the isotropic tensor
basis with coefficients c(J, I1, I2), flow as the share of the strain that relaxes within a substep. The correction
multiplies the moduli, and the resistance to flow (yield strain, relaxation time), by exp of A B h(invariants), h a
small network, B of few rows, A zero at the start. For all weights the law is at rest at F = I, isotropic and
frame indifferent, with positive moduli; at the start it is the classical law (Hencky's strain to third order).

differs from NeuMA: that adds low-rank matrices to the weights of a neural law, trained on the classical one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from masiv.materials.classical import ClassicalLaw, isochoric_flow
from masiv.materials.law import BoundLaw, Law
from masiv.materials.neural import NeuralLaw, strain_invariants

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

FEATURE_STRAIN = 0.02
"""Strain [1] beyond which the correction sees invariants logarithmically."""
MAX_LOG_FACTOR = 2.0
"""Corrections are factors of exp(-MAX_LOG_FACTOR) to exp(MAX_LOG_FACTOR)."""
MIN_STRAIN = 1e-12


class AdapterLaw(Law):
    """``base`` (its parameters are kept) corrected by a network 3 -> width -> rank -> 4.

    The corrections are those of the two shear moduli, of the bulk modulus, and of the resistance to flow.
    """

    kind = "adapter"

    def __init__(self, base: ClassicalLaw, *, width: int = 16, rank: int = 2, seed: int = 0) -> None:
        super().__init__()
        self.base = base.requires_grad_(False)
        self.width, self.rank = width, rank
        generator = torch.Generator().manual_seed(seed)
        self.hidden = torch.nn.Linear(3, width)
        self.down = torch.nn.Linear(width, rank, bias=False)
        self.up = torch.nn.Linear(rank, 4, bias=False)
        for layer in (self.hidden, self.down):
            torch.nn.init.xavier_uniform_(layer.weight, generator=generator)
        torch.nn.init.uniform_(self.hidden.bias, -1.0, 1.0, generator=generator)
        torch.nn.init.zeros_(self.up.weight)

    def correction(self, invariants: torch.Tensor) -> torch.Tensor:
        """Logarithms (N, 4) of the factors on g1, g2, kappa and on the resistance to flow."""
        hidden = torch.tanh(self.hidden(NeuralLaw.features(invariants, FEATURE_STRAIN)))
        return MAX_LOG_FACTOR * torch.tanh(self.up(self.down(hidden)) / MAX_LOG_FACTOR)

    def moduli(self, invariants: torch.Tensor) -> torch.Tensor:
        """Coefficients (N, 4) [Pa] of ``masiv.kernels.isotropic.stress`` from invariants (N, 3)."""
        factor = torch.exp(self.correction(invariants))
        g1, g2, kappa, coupling = base_moduli(self.base, invariants).unbind(1)
        return torch.stack([g1 * factor[:, 0], g2 * factor[:, 1], kappa * factor[:, 2], coupling * factor[:, 0]], dim=1)

    def flow_share(self, invariants: torch.Tensor, dt: float) -> torch.Tensor:
        """Shares (N, 2) of the isochoric and volumetric elastic strain that flow within dt [s]."""
        if self.base.kind == "neo_hookean":
            return torch.zeros(len(invariants), 2, dtype=invariants.dtype)
        return base_flow_share(self.base, invariants, dt, torch.exp(self.correction(invariants)[:, 3]))

    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        share = self.flow_share(strain_invariants(trial_gradient), dt)
        j = torch.linalg.det(trial_gradient)
        volume = j ** (-share[:, 1] / 3)
        return volume[:, None, None] * isochoric_flow(trial_gradient, share[:, 0, None, None])

    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        g1, g2, kappa, coupling = self.moduli(strain_invariants(deformation_gradient))[:, :, None, None].unbind(1)
        eye = torch.eye(3, dtype=deformation_gradient.dtype)
        j = torch.linalg.det(deformation_gradient)[:, None, None]
        b = j ** (-2 / 3) * (deformation_gradient @ deformation_gradient.mT)
        b_inverse = torch.linalg.inv(b)
        traces = [a.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] for a in (b, b_inverse)]
        pressure = 0.5 * kappa * (j - 1 / j) + coupling * (traces[0] - 3)
        return g1 * (b - traces[0] / 3 * eye) - g2 * (b_inverse - traces[1] / 3 * eye) + pressure * eye

    def wave_modulus(self) -> float:
        with torch.no_grad():
            g1, g2, kappa, _ = self.moduli(torch.zeros(1, 3, dtype=self.hidden.weight.dtype))[0].tolist()
        return kappa + 4.0 / 3.0 * (g1 + g2)

    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        return _BoundAdapter(self, kernels, count, dt)

    def description(self) -> dict[str, Any]:
        """The parameters are those of the classical law that is corrected."""
        return {
            "kind": self.kind,
            "base": self.base.kind,
            "rank": self.rank,
            "parameters": self.base.description()["parameters"],
        }

    def file_metadata(self) -> dict[str, str]:
        base = self.base.file_metadata()
        return {
            "kind": self.kind, "base": base["kind"], "stderr": base["stderr"], "width": str(self.width),
            "rank": str(self.rank),
        }  # fmt: skip

    @classmethod
    def from_state(cls, metadata: dict[str, str], state: dict[str, torch.Tensor]) -> AdapterLaw:
        """The law whose ``file_metadata`` and ``state_dict`` these are."""
        own = {name.removeprefix("base."): value for name, value in state.items() if name.startswith("base.")}
        base = ClassicalLaw.from_state(metadata["base"], own)
        law = cls(base, width=int(metadata["width"]), rank=int(metadata["rank"]))
        law.to(state["hidden.weight"].dtype)
        law.base.to(torch.float64)
        return law


def base_moduli(law: ClassicalLaw, invariants: torch.Tensor) -> torch.Tensor:
    """A classical stress as coefficients (N, 4) [Pa] of ``masiv.kernels.isotropic.stress``.

    Exact for neo-Hookean solids and fluids; of Hencky's strain, ln b is dev(b - b^-1) / (2 sqrt(1 + q/3)) to third
    order, q = (I1 + I2)/2 - 3.
    """
    mu, lam = (float(m.detach()) for m in law.elastic_moduli())
    log_j, first, second = invariants.unbind(1)
    zero = torch.zeros_like(log_j)
    if law.kind == "neo_hookean":
        shear = mu * torch.exp(2 / 3 * log_j)
        pressure = mu * torch.expm1(2 / 3 * log_j) + lam * log_j
        return torch.stack([shear, zero, _over_sinh(pressure, log_j, 2 / 3 * mu + lam), shear / 3], dim=1)
    if law.kind == "newtonian":
        bulk = float(law.values["bulk_modulus"].detach())
        pressure = bulk / 7 * (torch.expm1(log_j) - torch.expm1(-6 * log_j))
        return torch.stack([mu + zero, zero, _over_sinh(pressure, log_j, bulk), zero], dim=1)
    if law.kind == "water":
        pressure = lam * torch.exp(log_j) * torch.expm1(log_j)
        return torch.stack([zero, zero, _over_sinh(pressure, log_j, lam), zero], dim=1)
    half = 0.5 * mu / torch.sqrt(1 + (first + second) / 6)
    bulk = lam + 2 / 3 * mu
    return torch.stack([half, half, _over_sinh(bulk * log_j, log_j, bulk), zero], dim=1)


def _over_sinh(pressure: torch.Tensor, log_j: torch.Tensor, slope: float) -> torch.Tensor:
    """pressure / ((J - 1/J) / 2), ``slope`` at J = 1."""
    near = log_j.abs() < 1e-4
    return torch.where(near, torch.full_like(log_j, slope), pressure / torch.sinh(torch.where(near, 1.0, log_j)))


def base_flow_share(law: ClassicalLaw, invariants: torch.Tensor, dt: float, resistance: torch.Tensor) -> torch.Tensor:
    """A classical return mapping as shares (N, 2) of isochoric and volumetric strain; resistance (N,): a factor on the
    yield strain, the friction or the relaxation time."""
    c = [float(v) for v in law.coefficients(dt).detach()]
    log_j = invariants[:, 0]
    zero = torch.zeros_like(log_j)
    if law.kind == "water":
        return torch.stack([zero + 1, zero], dim=1)
    if law.kind == "newtonian":
        return torch.stack([c[2] / (c[2] + (1 - c[2]) * resistance), zero], dim=1)
    size = hencky_size(invariants)
    if law.kind == "drucker_prager":
        reach = -(3 * c[1] + 2 * c[0]) / (2 * c[0]) * log_j * c[2] * resistance
        share = torch.relu(1 - torch.relu(reach) / size)
        free = log_j >= 0
        return torch.stack([torch.where(free, zero + 1, share), torch.where(free, zero + 1, zero)], dim=1)
    share = torch.relu(1 - c[2] / (2 * c[0]) * resistance / size)
    if law.kind == "non_newtonian":
        share = share / (1 + c[3] * resistance)
    return torch.stack([share, zero], dim=1)


def hencky_size(invariants: torch.Tensor) -> torch.Tensor:
    """|dev ln V| (N,) to third order, from |dev(b - b^-1)|^2 by Cayley and Hamilton. At least ``MIN_STRAIN``."""
    first, second = invariants[:, 1], invariants[:, 2]
    square = 4 * (first + second) + first**2 + second**2 - (first - second) ** 2 / 3
    return torch.sqrt(torch.relu(square) / (1 + (first + second) / 6) / 16 + MIN_STRAIN**2)


class _BoundAdapter(BoundLaw):
    """Coefficients from torch between two kernels: invariants out, coefficients in."""

    def __init__(self, law: AdapterLaw, mpm: MpmKernels, count: int, dt: float) -> None:
        from masiv.kernels.law_kernels import InvariantKernels

        self.law = law
        self.dt = dt
        self.kernels = mpm.attached(InvariantKernels, lambda: InvariantKernels(mpm))
        self.trained = [p for p in law.parameters() if p.requires_grad]
        self.sums = [torch.zeros_like(p) for p in self.trained]
        dtype = law.hidden.weight.dtype
        self.trial, self.final = torch.empty(count, 3, dtype=dtype), torch.empty(count, 3, dtype=dtype)
        self.share_bar, self.moduli_bar = torch.empty(count, 2, dtype=dtype), torch.empty(count, 4, dtype=dtype)

    def forward(self, s: int, count: int) -> None:
        with torch.no_grad():
            self.kernels.trial_invariants(s, self.trial)
            self.kernels.flow(s, self.law.flow_share(self.trial, self.dt).contiguous(), self.final)
            self.kernels.elastic(s, self.law.moduli(self.final).contiguous())

    def backward(self, s: int, count: int) -> None:
        k = self.kernels
        k.final_invariants(s, self.final)
        final = self.final.clone().requires_grad_()
        moduli = self.law.moduli(final)
        k.elastic_adjoint(s, moduli.detach().contiguous(), self.moduli_bar)
        final_bar = self._through(moduli, final, self.moduli_bar)
        k.trial_invariants(s, self.trial)
        trial = self.trial.clone().requires_grad_()
        share = self.law.flow_share(trial, self.dt)
        k.flow_adjoint(s, share.detach().contiguous(), final_bar, self.share_bar)
        if share.requires_grad:
            k.add_trial_invariants_adjoint(s, self._through(share, trial, self.share_bar))

    def _through(self, output: torch.Tensor, invariants: torch.Tensor, bar: torch.Tensor) -> torch.Tensor:
        """Adjoint (N, 3) of the invariants; gradients of the weights are added up."""
        bars = torch.autograd.grad(output, (invariants, *self.trained), bar, allow_unused=True)
        for total, part in zip(self.sums, bars[1:], strict=True):
            if part is not None:
                total += part
        return bars[0].contiguous()

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        sums = iter(self.sums)
        return tuple(next(sums) if p.requires_grad else None for p in self.law.parameters())
