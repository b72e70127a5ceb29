"""A clamp: nodes of the grid that are held still. Part of a scene, not of the library of effects."""

import functools

import taichi as ti
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import Effect, EffectParameter


def _holding(planes):
    @ti.func
    def held_still(x, v, held, t, dt, dx, c):
        inside = True
        for p in ti.static(range(planes)):
            # Nodes nearer than half a cell belong to the region: a face on a plane of nodes holds that plane.
            if x[0] * c[4 * p] + x[1] * c[4 * p + 1] + x[2] * c[4 * p + 2] > c[4 * p + 3] + 0.5 * dx:
                inside = False
        kept = 1.0
        if inside:
            kept = 0.0
        return kept * v

    return held_still


class Clamp(Effect):
    """v = 0 in {x : n_p · x ≤ h_p for all p}. Its parameters are constants: n_p and h_p of each plane."""

    name = "clamp"
    looks_like = "a part of the body is held"
    strengths = 0
    on_grid = "nodes"

    def __init__(self, planes: int) -> None:
        self.planes = planes
        names = (("x", "1"), ("y", "1"), ("z", "1"), ("height", "m"))
        self.parameters = tuple(
            EffectParameter(f"{name}{p}", unit, -1e3, 1e3, 1e-3) for p in range(planes) for name, unit in names
        )

    def node_velocity(self):
        return _holding(self.planes)


@functools.lru_cache(maxsize=8)
def clamp_effect(planes: int) -> Clamp:
    """One a number of planes: kernels are compiled for the object."""
    return Clamp(planes)


def clamped(effects: ActiveEffects, normals: torch.Tensor, heights: torch.Tensor) -> ActiveEffects:
    """``effects`` with a clamp after them, so that none of them moves a held node.

    normals (P, 3), unit, and heights (P,) [m], simulation frame.
    """
    planes = torch.cat([normals, heights[:, None]], dim=1).detach().reshape(-1)
    return ActiveEffects((*effects.members, (clamp_effect(len(heights)), planes)), effects.setting)
