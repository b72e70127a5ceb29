"""A clamp: nodes of the grid whose velocity is zero."""

from __future__ import annotations

import taichi as ti
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.planes import PlanesEffect, with_planes


def _zero_inside(planes):
    @ti.func
    def clamped_velocity(x, v, t, dt, dx, c):
        inside = True
        for p in ti.static(range(planes)):
            # Nodes nearer than half a cell belong to the region: a face on a plane of nodes holds that plane.
            if x[0] * c[4 * p] + x[1] * c[4 * p + 1] + x[2] * c[4 * p + 2] > c[4 * p + 3] + 0.5 * dx:
                inside = False
        kept = 1.0
        if inside:
            kept = 0.0
        return kept * v

    return clamped_velocity


class Clamp(PlanesEffect):
    r"""$v_i = 0$ for $x_i \in \{x : n_p \cdot x \le h_p \;\forall p\}$."""

    name = "clamp"
    looks_like = "a part of the body is held"

    def node_velocity(self):
        return _zero_inside(self.planes)


def with_clamp(effects: ActiveEffects, normals: torch.Tensor, heights: torch.Tensor) -> ActiveEffects:
    """``effects`` with a clamp of the convex region n_p · x ≤ h_p.

    normals (P, 3): unit vectors; heights (P,) [m]; simulation frame.
    """
    return with_planes(effects, Clamp, normals, heights)
