"""A clamp: nodes of the grid whose velocity is zero, or that of a rigid motion."""

from __future__ import annotations

import functools

import taichi as ti
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.planes import PlanesEffect, earlier, with_planes
from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect


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


FIRST_PLANE = 16
"""Coefficients of a ``MovingClamp`` before those of its planes."""


def _rigid_inside(planes):
    @ti.func
    def carried_velocity(x, v, t, dt, dx, c):
        # Velocity in the middle of the substep: the sum over substeps is then the path to second order.
        now, middle = t - c[0], t + 0.5 * dt - c[0]
        centre, path_velocity = 0.0 * x, 0.0 * x
        for a in ti.static(range(3)):
            centre[a] = c[1 + a] + now * (c[4 + a] + now * (c[7 + a] + now * c[10 + a]))
            path_velocity[a] = c[4 + a] + middle * (2.0 * c[7 + a] + 3.0 * middle * c[10 + a])
        arm = x - centre
        inside = True
        for p in ti.static(range(planes)):
            n = ti.Vector([c[16 + 4 * p], c[17 + 4 * p], c[18 + 4 * p]])
            if arm.dot(n) > c[19 + 4 * p] + 0.5 * dx:
                inside = False
        out = v
        if inside:
            out = path_velocity + ti.Vector([c[13], c[14], c[15]]).cross(arm)
        return out

    return carried_velocity


class MovingClamp(NodalEffect):
    r"""$v_i = \dot p(t) + \omega \times (x_i - p(t))$ for $x_i \in \{x : n_k \cdot (x - p(t)) \le h_k \;\forall k\}$.

    Parameters: the start $t_0$ [s]; $p(t) = \sum_k a_k (t - t_0)^k$ [m], twelve numbers; $\omega$ [rad/s]; $n_k$ and
    $h_k$ [m] of each plane. They hold for a short time, in which the planes turn little.
    """

    name = "moving_clamp"
    looks_like = "a part of the body is carried"
    strengths = 0

    def __init__(self, planes: int) -> None:
        self.planes = planes
        count = FIRST_PLANE + 4 * planes
        self.parameters = tuple(EffectParameter(f"coefficient{k}", "SI", -1e12, 1e12, 1e-3) for k in range(count))

    def node_velocity(self):
        return _rigid_inside(self.planes)


@functools.cache
def _moving_clamp(planes: int, which: int) -> MovingClamp:
    """One object for each number of planes and number in a rollout: kernels are compiled for the object."""
    return MovingClamp(planes)


def with_moving_clamp(
    effects: ActiveEffects,
    start: float,
    position: torch.Tensor,
    omega: torch.Tensor,
    normals: torch.Tensor,
    heights: torch.Tensor,
) -> ActiveEffects:
    """``effects`` with a clamp that is carried, from ``start`` [s] on: see ``MovingClamp``. position (4, 3): a_0 to
    a_3; omega (3,) [rad/s]; normals (P, 3), heights (P,) [m]; simulation frame."""
    planes = torch.cat([normals, heights[:, None]], dim=1).reshape(-1)
    first = torch.tensor([start], dtype=position.dtype)
    values = torch.cat([first, position.reshape(-1), omega, planes.to(position.dtype)]).detach()
    effect = _moving_clamp(len(heights), earlier(effects, MovingClamp, len(heights)))
    return ActiveEffects((*effects.members, (effect, values)), effects.context)
