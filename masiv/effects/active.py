"""Effects with the values of their parameters: what they add up to in a rollout."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from masiv.effects.context import EffectContext
from masiv.effects.effect import (
    ClockEffect,
    ContactEffect,
    Effect,
    ForceEffect,
    GeometryEffect,
    HistoryEffect,
    MassEffect,
    NodalEffect,
    StressEffect,
    SuspendedMass,
    SuspendedMassEffect,
)
from masiv.effects.stability import SubstepDemand
from masiv.errors import InputError

E = TypeVar("E", bound=Effect)


@dataclass(frozen=True)
class ActiveEffects:
    """Effects with the values (P,) of their parameters.

    Raises InputError if two of them replace the contact, keep internal variables or hang from the body, or if values do
    not have the shape of the parameters.
    """

    members: tuple[tuple[Effect, torch.Tensor], ...]
    context: EffectContext

    def __post_init__(self) -> None:
        contacts = [effect.name for effect, _ in self.of_kind(ContactEffect)]
        if len(contacts) > 1:
            raise InputError(f"{' and '.join(contacts)} both replace the contact with the ground: use one of them")
        remembered = [effect.name for effect, _ in self.of_kind(HistoryEffect)]
        if len(remembered) > 1:
            raise InputError(f"{' and '.join(remembered)} both keep internal variables: use one of them")
        hung = [effect.name for effect, _ in self.of_kind(SuspendedMassEffect)]
        if len(hung) > 1:
            raise InputError(f"{' and '.join(hung)} both hang from the body: use one of them")
        for effect, theta in self.members:
            if theta.shape != (len(effect.parameters),):
                raise InputError(
                    f"effect {effect.name}: values of shape {tuple(theta.shape)}, give one for each of "
                    f"{', '.join(p.name for p in effect.parameters)}"
                )

    def of_kind(self, kind: type[E]) -> list[tuple[E, torch.Tensor]]:
        """The members of that kind, in order."""
        return [(effect, theta) for effect, theta in self.members if isinstance(effect, kind)]

    @property
    def kernel_members(self) -> list[tuple[NodalEffect | ContactEffect | StressEffect, torch.Tensor]]:
        """Those with Taichi functions: the nodes' effects, then the contact's, then those on the stress. Of a kind, by
        name, and last what has no strength, a boundary condition: the order of members changes nothing."""
        kinds = (NodalEffect, ContactEffect, StressEffect)
        return [m for kind in kinds for m in sorted(self.of_kind(kind), key=lambda m: (not m[0].strengths, m[0].name))]

    def coefficients(self) -> list[torch.Tensor]:
        """Coefficients of ``kernel_members``, differentiable: (K,) for one on the grid, (N, K) on the stress."""
        return [effect.coefficients(theta, self.context) for effect, theta in self.kernel_members]

    @torch.no_grad()
    def substep_demand(self) -> SubstepDemand:
        """What all of them ask of the substep in addition to the law."""
        total = nothing = SubstepDemand()
        for effect, theta in self.of_kind(StressEffect):
            own = effect.substep_demand(theta, self.context)
            total = total.then(own if own == nothing else replace(own, effects=(effect.name,)))
        return total

    def mass_factor(self) -> torch.Tensor | None:
        """Product (N,) of the factors of mass; None if no effect has one."""
        factors = [effect.mass_factor(theta, self.context) for effect, theta in self.of_kind(MassEffect)]
        return functools.reduce(torch.mul, factors) if factors else None

    def force(self) -> torch.Tensor | None:
        """Sum (N, 3) [N] of the forces on the particles; None if no effect has one."""
        forces = [effect.force(theta, self.context) for effect, theta in self.of_kind(ForceEffect)]
        return functools.reduce(torch.add, forces) if forces else None

    @torch.no_grad()
    def suspended_mass(self) -> SuspendedMass | None:
        """The mass that hangs from the body; None if there is none."""
        masses = [effect.suspended_mass(theta, self.context) for effect, theta in self.of_kind(SuspendedMassEffect)]
        return masses[0] if masses else None

    def ground_shift(self) -> torch.Tensor:
        """Height () [m] by which the ground is raised."""
        return _sum(effect.ground_shift(theta) for effect, theta in self.of_kind(GeometryEffect))

    def time_shift(self) -> torch.Tensor:
        """Delay () [s] of the frames after their time stamps."""
        return _sum(effect.time_shift(theta) for effect, theta in self.of_kind(ClockEffect))


def _sum(terms: Iterable[torch.Tensor]) -> torch.Tensor:
    return sum(terms, torch.zeros(()))
