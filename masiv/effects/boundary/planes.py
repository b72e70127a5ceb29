"""Boundary conditions on one side of planes whose normals and heights are constants."""

from __future__ import annotations

import functools

import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.context import EffectParameter
from masiv.effects.effect import Effect, NodalEffect


class PlanesEffect(NodalEffect):
    """Acts on nodes on one side of ``planes`` planes n_p · x = h_p. Its parameters are n_p and h_p of each plane."""

    strengths = 0

    def __init__(self, planes: int) -> None:
        self.planes = planes
        names = (("x", "1"), ("y", "1"), ("z", "1"), ("height", "m"))
        self.parameters = tuple(
            EffectParameter(f"{name}{p}", unit, -1e3, 1e3, 1e-3) for p in range(planes) for name, unit in names
        )


@functools.cache
def _planes_effect(kind: type[PlanesEffect], planes: int, which: int) -> PlanesEffect:
    """One object for each kind, number of planes and number in a rollout: kernels are compiled for the object."""
    return kind(planes)


def earlier(effects: ActiveEffects, kind: type[Effect], planes: int) -> int:
    """How many of ``kind`` with so many ``planes`` there are."""
    return sum(isinstance(effect, kind) and getattr(effect, "planes", 0) == planes for effect, _ in effects.members)


def with_planes(
    effects: ActiveEffects, kind: type[PlanesEffect], normals: torch.Tensor, heights: torch.Tensor
) -> ActiveEffects:
    """``effects`` followed by one of ``kind``, so that none of them moves a node that it acts on.

    normals (P, 3): unit vectors; heights (P,) [m]; simulation frame.
    """
    planes = torch.cat([normals, heights[:, None]], dim=1).detach().reshape(-1)
    effect = _planes_effect(kind, len(heights), earlier(effects, kind, len(heights)))
    return ActiveEffects((*effects.members, (effect, planes)), effects.context)
