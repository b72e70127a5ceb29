"""Walls without friction: nodes at or behind a plane move along it alone. Part of a scene, not of the library."""

from __future__ import annotations

import functools

import taichi as ti
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import Effect, EffectParameter


def _sliding(planes):
    @ti.func
    def slid(x, v, held, t, dt, dx, c):
        out = v
        for p in ti.static(range(planes)):
            n = ti.Vector([c[4 * p], c[4 * p + 1], c[4 * p + 2]])
            if x.dot(n) <= c[4 * p + 3] + 1e-3 * dx:  # a plane of nodes in the wall belongs to it
                out -= out.dot(n) * n
        return out

    return slid


class Walls(Effect):
    """v · n_p = 0 in {x : n_p · x ≤ h_p}, for each plane p: a wall that matter slides along and does not leave, which
    is a plane of symmetry as well. Its parameters are constants: n_p and h_p of each plane.

    A plane with h beyond all matter makes a motion plane: one layer of particles is then a two-dimensional body.
    """

    name = "walls"
    looks_like = "a part of the body slides along a wall"
    strengths = 0
    on_grid = "nodes"

    def __init__(self, planes: int) -> None:
        self.planes = planes
        names = (("x", "1"), ("y", "1"), ("z", "1"), ("height", "m"))
        self.parameters = tuple(
            EffectParameter(f"{name}{p}", unit, -1e3, 1e3, 1e-3) for p in range(planes) for name, unit in names
        )

    def node_velocity(self):
        return _sliding(self.planes)


@functools.lru_cache(maxsize=8)
def _walls_effect(planes: int) -> Walls:
    """One a number of planes: kernels are compiled for the object."""
    return Walls(planes)


def walled(effects: ActiveEffects, normals: torch.Tensor, heights: torch.Tensor) -> ActiveEffects:
    """``effects`` with walls after them. normals (P, 3), unit, into the matter, perpendicular to each other (so that
    the order of walls in a corner does not matter); heights (P,) [m], simulation frame."""
    planes = torch.cat([normals, heights[:, None]], dim=1).detach().reshape(-1)
    return ActiveEffects((*effects.members, (_walls_effect(len(heights)), planes)), effects.setting)
