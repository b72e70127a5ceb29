"""The rigid motion before the first contact: initial velocity and spin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.scene.scene import Ground

SUDDEN = 4.0
"""How much farther than in the frames before a body is from rigid when it has hit something."""


@dataclass(frozen=True)
class Launch:
    """velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] at frame 0; from frames 0…last_frame."""

    velocity: np.ndarray
    omega: np.ndarray
    last_frame: int


def estimate_launch(
    positions: np.ndarray, times: np.ndarray, gravity: np.ndarray, ground: Ground | None, clearance: float
) -> Launch:
    """Least squares on free flight, x(t) = c + v t + g t^2 / 2 + exp([omega] t) (x0 - c).

    positions (T, N, 3) [m] at times (T,) [s]. Flight ends before the first frame whose lowest hundredth of particles is
    within ``clearance`` [m] of the ground, and before the body suddenly leaves a rigid motion (the ground may be where
    nobody said); where that is at once, frames 0 and 1 have to do.
    """
    last = len(times) - 1
    if ground is not None:
        heights = np.quantile(positions @ ground.normal - ground.height, 0.01, axis=1)
        touching = np.flatnonzero(heights[1:] < clearance)
        if len(touching):
            last = max(1, int(touching[0]))
    last = still_rigid(beyond_rigid(positions[: last + 1]))
    t = times[1 : last + 1]
    centres = positions[: last + 1].mean(1)
    # Fall is known, so that what is left is linear in time; late frames tell more of a velocity: least squares through
    # 0.
    drift = centres[1:] - centres[0] - 0.5 * gravity * t[:, None] ** 2
    velocity = (t[:, None] * drift).sum(0) / (t**2).sum()
    arms = positions[0] - centres[0]
    turns = np.stack(
        [Rotation.align_vectors(positions[k] - centres[k], arms)[0].as_rotvec() for k in range(1, last + 1)]
    )
    omega = (t[:, None] * turns).sum(0) / (t**2).sum()
    return Launch(velocity, omega, last)


def beyond_rigid(positions: np.ndarray) -> np.ndarray:
    """Root mean square distance (T - 1,) [m] of positions (T, N, 3) [m] after the first from its best rigid motion."""
    start = positions[0] - positions[0].mean(0)
    out = []
    for later in positions[1:]:
        now = later - later.mean(0)
        turn = Rotation.align_vectors(now, start)[0]
        out.append(np.sqrt(((now - turn.apply(start)) ** 2).sum(1).mean()))
    return np.array(out)


def still_rigid(distances: np.ndarray) -> int:
    """How many of the frames with these ``beyond_rigid`` pass before the body hits something; at least two are taken to
    be free, if there are as many."""
    for frame in range(2, len(distances)):
        if distances[frame] > SUDDEN * np.median(distances[:frame]):
            return frame
    return len(distances)
