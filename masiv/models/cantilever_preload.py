"""A body that is not let go straight: its start in the shape in which its own weight would bend it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from masiv.models.marker_body import SimulatedBody


def across(body: SimulatedBody) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Unit vectors (3,), simulation frame: out of the clamp, and up across it. None where there is no clamp, or where
    the body hangs or stands."""
    gravity = torch.as_tensor(body.gravity, dtype=torch.float64)
    if not len(body.heights) or not gravity.norm() > 0:
        return None
    normal = body.normals[0].double()
    up = -gravity / gravity.norm()
    up = up - (up @ normal) * normal
    return None if up.norm() < 0.2 else (normal, up / up.norm())


def bent(body: SimulatedBody, lift: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (N, 3) [m, simulation frame] and deformation gradients (N, 3, 3) of the particles where the end that is
    farthest from the clamp is ``lift`` [m] above its place in the straight body.

    The shape is that of a cantilever under a uniform load, φ = (6 ξ² − 4 ξ³ + ξ⁴) / 3 with ξ = s / S the distance from
    the clamp: u = lift (φ e − r φ' n), r the height over the body's middle, so that sections stay plane and
    perpendicular to the axis (Euler and Bernoulli). To first order in lift / S.
    """
    x = body.particles.double()
    eye = torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)
    axes = across(body)
    if axes is None or lift == 0:
        return x, eye
    n, e = axes
    depth = (x @ n - body.heights[0].double()).clamp_min(0.0)
    length = depth.max()
    xi = depth / length
    height = (x - x.mean(0)) @ e
    shape = (6 * xi**2 - 4 * xi**3 + xi**4) / 3
    slope = (12 * xi - 12 * xi**2 + 4 * xi**3) / (3 * length)
    curvature = 4 * (1 - xi) ** 2 / length**2
    moved = lift * (shape[:, None] * e - (height * slope)[:, None] * n)
    turn = torch.outer(e, n) - torch.outer(n, e)
    gradient = slope[:, None, None] * turn - (height * curvature)[:, None, None] * torch.outer(n, n)
    return x + moved, eye + lift * gradient
