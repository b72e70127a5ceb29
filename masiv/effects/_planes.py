"""Effects of a set of planes whose numbers are constants: parts of a scene, not of the library of effects."""

from __future__ import annotations

import functools

import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import Effect, EffectParameter


class OfPlanes(Effect):
    """An effect on the nodes whose parameters are constants: n_p and h_p of each plane n_p · x = h_p."""

    strengths = 0
    on_grid = "nodes"

    def __init__(self, planes: int) -> None:
        self.planes = planes
        names = (("x", "1"), ("y", "1"), ("z", "1"), ("height", "m"))
        self.parameters = tuple(
            EffectParameter(f"{name}{p}", unit, -1e3, 1e3, 1e-3) for p in range(planes) for name, unit in names
        )


@functools.lru_cache(maxsize=16)
def _made(kind: type[OfPlanes], planes: int) -> OfPlanes:
    """One a kind and number of planes: kernels are compiled for the object."""
    return kind(planes)


def with_planes(
    effects: ActiveEffects, kind: type[OfPlanes], normals: torch.Tensor, heights: torch.Tensor
) -> ActiveEffects:
    """``effects`` with one of ``kind`` after them. normals (P, 3), unit, heights (P,) [m], simulation frame."""
    planes = torch.cat([normals, heights[:, None]], dim=1).detach().reshape(-1)
    return ActiveEffects((*effects.members, (_made(kind, len(heights)), planes)), effects.setting)
