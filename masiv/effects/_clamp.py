"""A clamp: nodes of the grid that are held still. Part of a scene, not of the library of effects."""

import taichi as ti
import torch

from masiv.effects._planes import OfPlanes, with_planes
from masiv.effects.active import ActiveEffects


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


class Clamp(OfPlanes):
    """v = 0 in {x : n_p · x ≤ h_p for all p}. Its parameters are constants: n_p and h_p of each plane."""

    name = "clamp"
    looks_like = "a part of the body is held"

    def node_velocity(self):
        return _holding(self.planes)


def clamped(effects: ActiveEffects, normals: torch.Tensor, heights: torch.Tensor) -> ActiveEffects:
    """``effects`` with a clamp after them, so that none of them moves a held node.

    normals (P, 3), unit, and heights (P,) [m], simulation frame.
    """
    return with_planes(effects, Clamp, normals, heights)
