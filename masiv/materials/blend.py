"""A material between two: the law of one run blended with that of another."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from masiv.errors import InputError, MasivError
from masiv.materials.classical import ClassicalLaw
from masiv.materials.law import BoundLaw, Law
from masiv.materials.neural import NeuralLaw

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

RATE_TIME = 1e-9
"""Time [s] within which even the fastest flow of a neural law is small, so that its share gives the rate."""


def blend(first: Law, second: Law, weight: float) -> Law:
    """The law ``weight`` of the way from ``first`` (0) to ``second`` (1).

    Two neural laws: ``BlendedLaw``. Two classical laws of one kind: its parameters in between, positive ones
    geometrically. Raises InputError for a weight outside of [0, 1] and for laws of two kinds: they keep their history
    in different ways, so that a return mapping between them would depend on the substep.
    """
    if not 0 <= weight <= 1:
        raise InputError(f"--blend {weight:g}: give a number from 0 (this run's law) to 1 (the other's)")
    if weight in (0, 1):
        return first if weight == 0 else second
    if isinstance(first, NeuralLaw) and isinstance(second, NeuralLaw):
        return BlendedLaw(first, second, weight)
    if isinstance(first, ClassicalLaw) and isinstance(second, ClassicalLaw) and first.kind == second.kind:
        return ClassicalLaw(first.kind, **_between(first, second, weight))
    raise InputError(
        f"--blend {weight:g}: a {first.kind} law and a {second.kind} law cannot be blended; give two neural laws, "
        "two classical ones of one kind, or --blend 1 for the other run's law alone"
    )


class BlendedLaw(Law):
    """Two neural laws: flow rates r = r_1^(1 - w) r_2^w, stresses (1 - w) tau_1 + w tau_2.

    Rates are decades apart (e^-14 of an elastic body, e^14 per second of a fluid), so they are blended geometrically.
    In steady flow the elastic strain of a law is inversely proportional to its rate. So the law that flows faster than
    the blend is evaluated at the fraction min(1, r / r_i) of the strain: it would never have reached all of it. Both
    laws are at rest at F = I, isotropic and frame indifferent, with positive moduli, and so is the blend; it does not
    depend on the substep either. Forward only.
    """

    kind = "blended"

    def __init__(self, first: NeuralLaw, second: NeuralLaw, weight: float) -> None:
        super().__init__()
        self.first, self.second, self.weight = first, second, float(weight)

    def log_rates(self, invariants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Logarithms (N, 2) of the isochoric and volumetric flow rates [1/s]: of the blend, the first, the second."""
        first, second = (
            torch.log(law.flow(invariants, RATE_TIME)) - math.log(RATE_TIME) for law in (self.first, self.second)
        )
        return (1 - self.weight) * first + self.weight * second, first, second

    def moduli(self, invariants: torch.Tensor) -> torch.Tensor:
        """As ``NeuralLaw.moduli``."""
        blended, *own = self.log_rates(invariants)
        parts = []
        for law, log_rate in zip((self.first, self.second), own, strict=True):
            shape, volume = torch.exp((_at_least_one(blended) - _at_least_one(log_rate)).clamp_max(0)).unbind(1)
            scaled = invariants * torch.stack([volume, shape**2, shape**2], dim=1)
            parts.append(law.moduli(scaled) * torch.stack([shape, shape, volume, shape**2], dim=1))
        return (1 - self.weight) * parts[0] + self.weight * parts[1]

    def flow_share(self, invariants: torch.Tensor, dt: float) -> torch.Tensor:
        """As ``NeuralLaw.flow_share``."""
        first, second = (torch.log(-torch.log1p(-law.flow_share(invariants, dt))) for law in (self.first, self.second))
        return -torch.expm1(-torch.exp((1 - self.weight) * first + self.weight * second))

    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        return NeuralLaw.project(self, trial_gradient, dt)  # type: ignore[arg-type]

    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        return NeuralLaw.stress(self, deformation_gradient)  # type: ignore[arg-type]

    def wave_modulus(self) -> float:
        with torch.no_grad():
            at_rest = self.moduli(torch.zeros(1, 3, dtype=self.first.log_stress_scale.dtype))
        g1, g2, kappa, _ = at_rest[0].tolist()
        return kappa + 4.0 / 3.0 * (g1 + g2)

    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        return _BoundBlend(self, kernels, count, dt)

    def description(self) -> dict[str, Any]:
        with torch.no_grad():
            at_rest = self.moduli(torch.zeros(1, 3, dtype=self.first.log_stress_scale.dtype))
        g1, g2, kappa, _ = at_rest[0].tolist()
        return {
            "kind": self.kind,
            "weight": self.weight,
            "parameters": {
                "shear_modulus_at_rest": {"value": g1 + g2, "unit": "Pa"},
                "bulk_modulus_at_rest": {"value": kappa, "unit": "Pa"},
            },
        }


def _at_least_one(log_rate: torch.Tensor) -> torch.Tensor:
    """Logarithm of a rate of at least 1 per second: slower flows count as none, however slow they are."""
    return log_rate.clamp_min(0)


def _between(first: ClassicalLaw, second: ClassicalLaw, weight: float) -> dict[str, float]:
    ends = {name: (float(value), float(second.values[name])) for name, value in first.values.items()}
    return {
        name: a ** (1 - weight) * b**weight if min(a, b) > 0 else (1 - weight) * a + weight * b
        for name, (a, b) in ends.items()
    }


class _BoundBlend(BoundLaw):
    """The definition itself, in torch, between the fields of the simulator."""

    def __init__(self, law: BlendedLaw, mpm: MpmKernels, count: int, dt: float) -> None:
        from masiv.kernels.pointwise import PointwiseKernels

        self.kernels, self.dt = mpm.attached(PointwiseKernels, lambda: PointwiseKernels(mpm)), dt
        self.law = BlendedLaw(law.first.frozen(), law.second.frozen(), law.weight)
        self.trial = torch.empty(count, 3, 3, dtype=law.first.log_stress_scale.dtype)

    def forward(self, s: int, count: int) -> None:
        with torch.no_grad():
            self.kernels.read_trial(s, self.trial)
            gradient = self.law.project(self.trial, self.dt)
            self.kernels.write(s, gradient, self.law.stress(gradient))

    def backward(self, s: int, count: int) -> None:
        raise MasivError("a blended law has no adjoint: it is simulated, not fitted")

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        raise MasivError("a blended law has no adjoint: it is simulated, not fitted")
