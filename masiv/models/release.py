"""How a body with markers begins to move: let go at rest, perhaps deflected by its own weight.

The parameters of a release are found from the motion of the run itself, since a reader knows the instant to a few
milliseconds only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from masiv.models.parameters import Parameter

NEWTON_STEPS = 8
DERIVATIVE_STEPS = 5.0
"""Finite-difference steps of the tip's deflection over which the motion's derivative is taken."""
LINEAR_STEPS = 0.5
"""Steps of the tip's deflection within which the motion is linear in it."""
MAX_PASSES = 3
MIN_SLANT = 0.2
"""Sine of the least angle between the clamp's normal and gravity at which a body bends under its weight."""


def fit_release(
    starts: Sequence[Parameter],
    times: np.ndarray,
    observed: np.ndarray,
    axes: np.ndarray,
    path_at: Callable[[float], CubicSpline],
) -> tuple[np.ndarray, np.ndarray]:
    """Values (S,) of ``starts`` that bring a run nearest to its own motion, by Gauss-Newton; and its markers (K, M, 3)
    [m] with them. observed (K, M, 3) [m] at ``times`` (K,) [s since the release that the reader found].

    starts: the delay of the release, offsets along the first of the ``axes`` (A, 3), and perhaps the tip's deflection,
    which comes last. path_at: markers (M, 3) over time for a deflection [m], one rollout each. With a deflection it is
    called three times (none, a small one, the one that was found), and once more if the motion is not linear there.
    """
    deflected = starts[-1].name.startswith("tip_deflection")
    axes = axes[: len(starts) - 1 - deflected]
    limits = np.array([p.upper for p in starts])
    start, here, path = np.zeros(len(starts)), 0.0, path_at(0.0)
    derivative = None
    if deflected:
        step = -DERIVATIVE_STEPS * starts[-1].step
        derivative = CubicSpline(path.x, (path_at(step)(path.x) - path(path.x)) / step)
    for _ in range(MAX_PASSES):
        start = _linear_fit(start, limits, times, observed, axes, path, derivative, here)
        if not deflected or abs(start[-1] - here) <= LINEAR_STEPS * starts[-1].step:
            break
        here = float(start[-1])
        path = path_at(here)
    return start, _markers(start, times, axes, path, derivative, here)


def _markers(
    start: np.ndarray, times: np.ndarray, axes: np.ndarray, path: CubicSpline, derivative: CubicSpline | None,
    here: float,
) -> np.ndarray:  # fmt: skip
    """Markers (K, M, 3) [m] at ``times`` with values ``start`` (S,); ``path`` is for the deflection ``here``."""
    at = np.clip(times - start[0], 0.0, None)
    markers = path(at) + start[1 : 1 + len(axes)] @ axes
    return markers if derivative is None else markers + (start[-1] - here) * derivative(at)


def _linear_fit(
    start: np.ndarray, limits: np.ndarray, times: np.ndarray, observed: np.ndarray, axes: np.ndarray,
    path: CubicSpline, derivative: CubicSpline | None, here: float,
) -> np.ndarray:  # fmt: skip
    """``start`` (S,) after Gauss-Newton steps within ``limits`` (S,); the motion is linear in the deflection."""
    velocity = path.derivative()
    for _ in range(NEWTON_STEPS):
        at = np.clip(times - start[0], 0.0, None)
        later = -velocity(at) * (times > start[0])[:, None, None]
        columns = [later, *(np.broadcast_to(axis, later.shape) for axis in axes)]
        if derivative is not None:
            columns.append(derivative(at))
        off = _markers(start, times, axes, path, derivative, here) - observed
        step = np.linalg.lstsq(np.stack([c.ravel() for c in columns], axis=1), -off.ravel(), rcond=None)[0]
        start = np.clip(start + step, -limits, limits)
    return start


def clamp_axes(gravity: np.ndarray, normals: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Unit vectors (3,): out of the clamp, and up across it. None if there is no clamp (``normals`` (P, 3) is empty),
    no gravity (3,) [m/s²], or if the body hangs or stands."""
    down = torch.as_tensor(gravity, dtype=torch.float64)
    if not len(normals) or not down.norm() > 0:
        return None
    normal = normals[0].double()
    up = -down / down.norm()
    up = up - (up @ normal) * normal
    return None if up.norm() < MIN_SLANT else (normal, up / up.norm())


def static_deflection(
    particles: torch.Tensor, clamp_height: torch.Tensor, axes: tuple[torch.Tensor, torch.Tensor], deflection: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (N, 3) [m] and deformation gradients (N, 3, 3) of a cantilever of ``particles`` (N, 3) whose free end
    is ``deflection`` [m] above its place in the straight body.

    clamp_height [m]: of the clamp's face along its normal; axes: of ``clamp_axes``, n and e. The shape is that under a
    uniform load (Euler and Bernoulli), to first order in deflection / S:

        φ = (6 ξ² − 4 ξ³ + ξ⁴) / 3,  ξ = s / S,  u = deflection (φ e − r φ' n)

    with s the distance from the clamp, S its greatest value and r the height over the body's middle: sections stay
    plane and perpendicular to the axis.
    """
    x = particles.double()
    n, e = axes
    depth = (x @ n - clamp_height.double()).clamp_min(0.0)
    length = depth.max()
    xi = depth / length
    height = (x - x.mean(0)) @ e
    shape = (6 * xi**2 - 4 * xi**3 + xi**4) / 3
    slope = (12 * xi - 12 * xi**2 + 4 * xi**3) / (3 * length)
    curvature = 4 * (1 - xi) ** 2 / length**2
    moved = deflection * (shape[:, None] * e - (height * slope)[:, None] * n)
    turn = torch.outer(e, n) - torch.outer(n, e)
    gradient = slope[:, None, None] * turn - (height * curvature)[:, None, None] * torch.outer(n, n)
    eye = torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)
    return x + moved, eye + deflection * gradient
