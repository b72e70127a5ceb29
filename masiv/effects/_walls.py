"""Walls without friction: nodes at or behind a plane move along it alone. Part of a scene, not of the library."""

from __future__ import annotations

import taichi as ti
import torch

from masiv.effects._planes import OfPlanes, with_planes
from masiv.effects.active import ActiveEffects


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


class Walls(OfPlanes):
    """v · n_p = 0 in {x : n_p · x ≤ h_p}, for each plane p: a wall that matter slides along and does not leave, which
    is a plane of symmetry as well. Its parameters are constants: n_p and h_p of each plane.

    A plane with h beyond all matter makes a motion plane: one layer of particles is then a two-dimensional body.
    """

    name = "walls"
    looks_like = "a part of the body slides along a wall"

    def node_velocity(self):
        return _sliding(self.planes)


def walled(effects: ActiveEffects, normals: torch.Tensor, heights: torch.Tensor) -> ActiveEffects:
    """``effects`` with walls after them. normals (P, 3), unit, into the matter, perpendicular to each other (so that
    the order of walls in a corner does not matter); heights (P,) [m], simulation frame."""
    return with_planes(effects, Walls, normals, heights)
