"""Classical laws with a few parameters. Formulas and sources: ``masiv.kernels.tensor``."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

import torch

from masiv.errors import InputError, MasivError
from masiv.materials.law import BoundLaw, Law

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

PARAMETERS = {
    "neo_hookean": ("youngs_modulus", "poissons_ratio"),
    "water": ("youngs_modulus", "poissons_ratio"),
    "von_mises": ("youngs_modulus", "poissons_ratio", "yield_stress"),
    "drucker_prager": ("youngs_modulus", "poissons_ratio", "friction_angle"),
}
UNITS = {"youngs_modulus": "Pa", "poissons_ratio": "1", "yield_stress": "Pa", "friction_angle": "deg"}
DIFFERENTIABLE = ("neo_hookean", "water")


def lame(youngs_modulus: torch.Tensor, poissons_ratio: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Lamé's mu and lambda [Pa]."""
    mu = youngs_modulus / (2 * (1 + poissons_ratio))
    return mu, youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))


class ClassicalLaw(Law):
    """A law of ``PARAMETERS``, its parameters given by name in the units of ``UNITS``.

    Raises InputError for an unknown kind, missing or unknown parameters, and values outside of their range.
    """

    def __init__(self, kind: str, **parameters: float) -> None:
        super().__init__()
        if kind not in PARAMETERS:
            raise InputError(f"unknown classical law '{kind}': use one of {', '.join(PARAMETERS)}")
        if set(parameters) != set(PARAMETERS[kind]):
            raise InputError(
                f"law {kind} needs exactly {', '.join(PARAMETERS[kind])}, got {', '.join(parameters) or 'none'}"
            )
        if not (parameters["youngs_modulus"] > 0 and -1 < parameters["poissons_ratio"] < 0.5):
            raise InputError(f"law {kind}: youngs_modulus must be > 0 and poissons_ratio within (-1, 0.5)")
        if parameters.get("yield_stress", 1.0) <= 0 or not 0 < parameters.get("friction_angle", 1.0) < 90:
            raise InputError(f"law {kind}: yield_stress must be > 0 Pa and friction_angle within (0, 90) degrees")
        self.kind = kind
        self.values = torch.nn.ParameterDict(
            {
                name: torch.nn.Parameter(torch.tensor(float(parameters[name]), dtype=torch.float64))
                for name in PARAMETERS[kind]
            }
        )

    @classmethod
    def from_state(cls, kind: str, state: dict[str, torch.Tensor]) -> ClassicalLaw:
        """The law whose ``state_dict`` is ``state``."""
        return cls(kind, **{name.removeprefix("values."): float(value) for name, value in state.items()})

    def coefficients(self) -> torch.Tensor:
        """What the kernels take, shape (K,): see the ``c`` of each function in ``masiv.kernels.tensor``."""
        mu, lam = lame(self.values["youngs_modulus"], self.values["poissons_ratio"])
        if self.kind == "neo_hookean":
            return torch.stack([mu, lam])
        if self.kind == "water":
            return lam[None]
        if self.kind == "von_mises":
            return torch.stack([mu, lam, self.values["yield_stress"]])
        sine = torch.sin(torch.deg2rad(self.values["friction_angle"]))
        return torch.stack([mu, lam, math.sqrt(2 / 3) * 2 * sine / (3 - sine)])

    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        if self.kind == "neo_hookean":
            return trial_gradient
        if self.kind == "water":
            eye = torch.eye(3, dtype=trial_gradient.dtype)
            return torch.linalg.det(trial_gradient)[:, None, None] ** (1 / 3) * eye
        u, s, vh = torch.linalg.svd(trial_gradient)
        strain = torch.log(s)
        c = self.coefficients().to(strain.dtype)
        trace = strain.sum(1, keepdim=True)
        deviator = strain - trace / 3
        size = deviator.norm(dim=1, keepdim=True).clamp_min(torch.finfo(strain.dtype).tiny)
        if self.kind == "von_mises":
            kept = trace / 3 + deviator * (c[2] / (2 * c[0]) / size).clamp_max(1)
        else:
            excess = size + (3 * c[1] + 2 * c[0]) / (2 * c[0]) * trace * c[2]
            kept = torch.where(trace >= 0, 0 * strain, strain - excess.clamp_min(0) * deviator / size)
        return u @ torch.diag_embed(torch.exp(kept)) @ vh

    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        c = self.coefficients().to(deformation_gradient.dtype)
        eye = torch.eye(3, dtype=deformation_gradient.dtype)
        j = torch.linalg.det(deformation_gradient)[:, None, None]
        if self.kind == "neo_hookean":
            return c[0] * (deformation_gradient @ deformation_gradient.mT - eye) + c[1] * torch.log(j) * eye
        if self.kind == "water":
            return c[0] * j * (j - 1) * eye
        u, s, _ = torch.linalg.svd(deformation_gradient)
        strain = torch.log(s)
        principal = 2 * c[0] * strain + c[1] * strain.sum(1, keepdim=True)
        return u @ torch.diag_embed(principal) @ u.mT

    def wave_modulus(self) -> float:
        mu, lam = lame(self.values["youngs_modulus"].detach(), self.values["poissons_ratio"].detach())
        return float(lam if self.kind == "water" else lam + 2 * mu)

    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        return _BoundClassical(self, kernels, count)

    def description(self) -> dict[str, Any]:
        values = {name: {"value": float(value), "unit": UNITS[name]} for name, value in self.values.items()}
        return {"kind": self.kind, "parameters": values}


@functools.lru_cache(maxsize=8)
def _classical_kernels(mpm, kind: str, coefficients: int):
    from masiv.kernels.laws import ClassicalKernels

    return ClassicalKernels(mpm, kind, coefficients)


class _BoundClassical(BoundLaw):
    def __init__(self, law: ClassicalLaw, mpm: MpmKernels, count: int) -> None:
        self.law = law
        self.mpm = mpm
        self.values = law.coefficients()
        self.kernels = _classical_kernels(mpm, law.kind, len(self.values))
        dtype = torch.float64 if "f64" in str(mpm.real) else torch.float32
        self.per_particle = self.values.detach().to(dtype).expand(count, -1).contiguous()
        self._write()

    def _write(self) -> None:
        self.kernels.write_coefficients(self.per_particle)
        self.kernels.owner = self

    def _own(self) -> None:
        if self.kernels.owner is not self:  # another rollout used the same fields since
            self._write()

    def forward(self, s: int, count: int) -> None:
        self._own()
        self.kernels.forward(s, count)

    def p2g(self, mpm: MpmKernels, s: int, count: int, nodes: int) -> None:
        if mpm.gpu:
            super().p2g(mpm, s, count, nodes)
        else:
            self._own()
            self.kernels.forward_p2g(s, count, nodes)

    def backward(self, s: int, count: int) -> None:
        if self.law.kind not in DIFFERENTIABLE:
            raise MasivError(f"law {self.law.kind} has no adjoint: identify with a neural law, or with neo_hookean")
        self._own()
        self.kernels.backward(s, count)

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        gradient = torch.empty_like(self.per_particle)
        self.kernels.read_coefficient_gradients(gradient)
        names = list(self.law.parameters())
        return torch.autograd.grad(self.law.coefficients(), names, gradient.double().sum(0), allow_unused=True)
