"""Classical laws with a few parameters. Formulas and sources: ``masiv.kernels.laws``."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import torch

from masiv.errors import InputError, MasivError
from masiv.materials.law import BoundLaw, Law, SharedBoundLaw

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

ELASTIC_PARAMETERS = ("youngs_modulus", "poissons_ratio")
PARAMETERS = {
    "neo_hookean": ELASTIC_PARAMETERS,
    "water": ELASTIC_PARAMETERS,
    "newtonian": ("viscosity", "bulk_modulus"),
    "von_mises": (*ELASTIC_PARAMETERS, "yield_stress"),
    "non_newtonian": ("shear_modulus", "bulk_modulus", "yield_stress", "plastic_viscosity"),
    "drucker_prager": (*ELASTIC_PARAMETERS, "friction_angle"),
    "springs": ("youngs_modulus", "viscosity"),
}
UNITS = {
    "youngs_modulus": "Pa",
    "poissons_ratio": "1",
    "shear_modulus": "Pa",
    "bulk_modulus": "Pa",
    "viscosity": "Pa s",
    "yield_stress": "Pa",
    "plastic_viscosity": "Pa s",
    "friction_angle": "deg",
}
RANGES = {"poissons_ratio": (-1.0, 0.5), "friction_angle": (0.0, 90.0)}
"""Open intervals of the parameters; (0, infinity) for the others."""
CONTINUUM = tuple(kind for kind in PARAMETERS if kind != "springs")
"""Laws of a continuum: a stress of the local deformation, for MPM. Springs connect particles instead."""
DIFFERENTIABLE = ("neo_hookean", "water")
"""Laws whose kernels have an adjoint."""
MAXWELL_SHARE = 0.25
MAXWELL_TIME = 2e-3
"""The shear modulus of a Newtonian fluid is MAXWELL_SHARE of its bulk modulus plus viscosity / MAXWELL_TIME [s]. Its
shear stress relaxes within MAXWELL_TIME, much faster than a flow changes between two frames, and hardly shortens the
substep."""


def lame(youngs_modulus: torch.Tensor, poissons_ratio: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Lamé's mu and lambda [Pa]."""
    mu = youngs_modulus / (2 * (1 + poissons_ratio))
    return mu, youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))


class ClassicalLaw(Law):
    """A law of ``PARAMETERS``, its parameters given by name in the units of ``UNITS``.

    ``stderr``: standard errors of the parameters by name, if they were estimated.
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
        for name, value in parameters.items():
            low, high = RANGES.get(name, (0.0, math.inf))
            if not low < value < high:
                raise InputError(
                    f"law {kind}: {name} = {value} {UNITS[name]} is out of range: give a value within ({low}, {high})"
                )
        self.kind = kind
        self.stderr: dict[str, float] = {}
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

    def elastic_moduli(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Lamé's mu and lambda [Pa] at rest; mu of a Newtonian fluid is that of its fast relaxation, of water 0."""
        if self.kind == "newtonian":
            mu = MAXWELL_SHARE * self.values["bulk_modulus"] + self.values["viscosity"] / MAXWELL_TIME
            return mu, self.values["bulk_modulus"] - 2 / 3 * mu
        if self.kind == "non_newtonian":
            mu = self.values["shear_modulus"]
            return mu, self.values["bulk_modulus"] - 2 / 3 * mu
        if self.kind == "springs":  # central forces: lambda = mu (Cauchy), E = 5/2 mu
            return 0.4 * self.values["youngs_modulus"], 0.4 * self.values["youngs_modulus"]
        mu, lam = lame(self.values["youngs_modulus"], self.values["poissons_ratio"])
        return (torch.zeros_like(mu) if self.kind == "water" else mu), lam

    def coefficients(self, dt: float) -> torch.Tensor:
        """What the kernels take in a substep of dt [s], shape (K,): see the ``c`` of each function in
        ``masiv.kernels.laws``."""
        return self.once(dt, lambda: self._coefficients(dt))

    def _coefficients(self, dt: float) -> torch.Tensor:
        mu, lam = self.elastic_moduli()
        if self.kind == "neo_hookean":
            return torch.stack([mu, lam])
        if self.kind == "water":
            return lam[None]
        if self.kind == "newtonian":
            return torch.stack([mu, self.values["bulk_modulus"] / 7, dt * mu / (dt * mu + self.values["viscosity"])])
        if self.kind == "von_mises":
            return torch.stack([mu, lam, self.values["yield_stress"]])
        if self.kind == "non_newtonian":
            return torch.stack([mu, lam, self.values["yield_stress"], self.values["plastic_viscosity"] / (mu * dt)])
        sine = torch.sin(torch.deg2rad(self.values["friction_angle"]))
        return torch.stack([mu, lam, math.sqrt(2 / 3) * 2 * sine / (3 - sine)])

    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        if self.kind in ("neo_hookean", "springs"):
            return trial_gradient
        c = self.coefficients(dt).to(trial_gradient.dtype)
        if self.kind == "water":
            eye = torch.eye(3, dtype=trial_gradient.dtype)
            return torch.linalg.det(trial_gradient)[:, None, None] ** (1 / 3) * eye
        if self.kind == "newtonian":
            return isochoric_flow(trial_gradient, c[2])
        u, s, vh = torch.linalg.svd(trial_gradient)
        strain = torch.log(s)
        trace = strain.sum(1, keepdim=True)
        deviator = strain - trace / 3
        size = deviator.norm(dim=1, keepdim=True).clamp_min(torch.finfo(strain.dtype).tiny)
        if self.kind == "von_mises":
            kept = trace / 3 + deviator * (c[2] / (2 * c[0]) / size).clamp_max(1)
        elif self.kind == "non_newtonian":
            excess = (size - c[2] / (2 * c[0])).clamp_min(0)
            kept = trace / 3 + deviator * (1 - excess / size / (1 + c[3]))
        else:
            excess = size + (3 * c[1] + 2 * c[0]) / (2 * c[0]) * trace * c[2]
            kept = torch.where(trace >= 0, 0 * strain, strain - excess.clamp_min(0) * deviator / size)
        return u @ torch.diag_embed(torch.exp(kept)) @ vh

    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        mu, lam = (m.to(deformation_gradient.dtype) for m in self.elastic_moduli())
        eye = torch.eye(3, dtype=deformation_gradient.dtype)
        j = torch.linalg.det(deformation_gradient)[:, None, None]
        if self.kind == "neo_hookean":
            return mu * (deformation_gradient @ deformation_gradient.mT - eye) + lam * torch.log(j) * eye
        if self.kind == "water":
            return lam * j * (j - 1) * eye
        if self.kind == "newtonian":
            b = j ** (-2 / 3) * (deformation_gradient @ deformation_gradient.mT)
            bulk = self.values["bulk_modulus"].to(b.dtype)
            return mu * (b - b.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * eye) + bulk / 7 * (j - j**-6) * eye
        if self.kind == "springs":
            return _mean_tension(deformation_gradient, self.values["youngs_modulus"].to(eye.dtype))
        u, s, _ = torch.linalg.svd(deformation_gradient)
        strain = torch.log(s)
        principal = 2 * mu * strain + lam * strain.sum(1, keepdim=True)
        return u @ torch.diag_embed(principal) @ u.mT

    def wave_modulus(self) -> float:
        mu, lam = self.elastic_moduli()
        return float((lam + 2 * mu).detach())

    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        if self.kind == "springs":
            raise MasivError("springs are between particles (masiv.mpm.spring_rollout): the grid has no kernel of them")
        return _BoundClassical(self, kernels, count, dt)

    def description(self) -> dict[str, Any]:
        """An estimated parameter also has ``stderr``, None if the data do not determine it."""
        values: dict[str, dict[str, Any]] = {}
        for name, value in self.values.items():
            values[name] = {"value": float(value.detach()), "unit": UNITS[name]}
            if name in self.stderr:
                values[name]["stderr"] = self.stderr[name] if math.isfinite(self.stderr[name]) else None
        return {"kind": self.kind, "parameters": values}

    def file_metadata(self) -> dict[str, str]:
        return {"kind": self.kind, "stderr": json.dumps(self.stderr)}


def _mean_tension(f: torch.Tensor, youngs_modulus: torch.Tensor) -> torch.Tensor:
    """Kirchhoff stress (N, 3, 3) [Pa] of springs in all directions n alike, by the Cauchy-Born rule: the mean of
    6 E (s - 1) / s (F n) (F n)^T with the stretch s = |F n|. ``masiv.mpm.spring_graph`` has the energy.

    Over the 26 directions of Lebedev's rule of degree 7: exact for small strain.
    """
    axis = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=f.dtype)] * 3)
    kind = axis.abs().sum(1).long()
    share = torch.tensor([0.0, 1 / 21, 4 / 105, 9 / 280], dtype=f.dtype)[kind]
    axis, length = axis[kind > 0], axis[kind > 0].norm(dim=1)
    moved = torch.einsum("nij,kj->nki", f, axis)
    stretch = moved.norm(dim=2) / length
    weight = 6 * youngs_modulus * share[kind > 0] * (stretch - 1) / stretch
    return torch.einsum("nk,nki,nkj->nij", weight / length**2, moved, moved)


def isochoric_flow(f: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
    """F (N, 3, 3) after a ``share`` of its isochoric Hencky strain has flowed: ``masiv.kernels.isotropic.flow``."""
    eye = torch.eye(3, dtype=f.dtype)
    b = torch.linalg.det(f)[:, None, None] ** (-2 / 3) * (f @ f.mT)
    b_inverse = torch.linalg.inv(b)
    traces = [a.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] for a in (b, b_inverse)]
    deviator = b - b_inverse - (traces[0] - traces[1]) / 3 * eye
    half = 0.125 * share / torch.sqrt(1 + (0.5 * (traces[0] + traces[1]) - 3) / 3) * deviator
    m = torch.linalg.solve(eye + half, eye - half)
    return torch.linalg.det(m)[:, None, None] ** (-1 / 3) * (m @ f)


class _BoundClassical(SharedBoundLaw):
    def __init__(self, law: ClassicalLaw, mpm: MpmKernels, count: int, dt: float) -> None:
        self.law = law
        self.dt = dt
        self.mpm = mpm
        self.values = law.coefficients(dt)
        from masiv.kernels.law_kernels import ClassicalKernels

        count_of = len(self.values)
        self.kernels = mpm.attached((ClassicalKernels, law.kind), lambda: ClassicalKernels(mpm, law.kind, count_of))
        self.per_particle = self.values.detach().to(mpm.torch_dtype).expand(count, -1).contiguous()
        self._own()

    def write(self) -> None:
        self.kernels.write_coefficients(self.per_particle)

    def backward(self, s: int, count: int) -> None:
        if self.law.kind not in DIFFERENTIABLE:
            raise MasivError(f"law {self.law.kind} has no adjoint: identify with a neural law, or with neo_hookean")
        super().backward(s, count)

    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        gradient = torch.empty_like(self.per_particle)
        self.kernels.read_coefficient_gradients(gradient)
        names = list(self.law.parameters())
        return torch.autograd.grad(self.law.coefficients(self.dt), names, gradient.double().sum(0), allow_unused=True)
