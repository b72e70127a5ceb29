"""The rigid motion before the first contact: initial velocity and spin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.rigid import beyond_rigid, first_contact_frame, free_flight
from masiv.scene.scene import Ground


@dataclass(frozen=True)
class InitialMotion:
    """velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] at frame 0; from frames 0…last_frame."""

    velocity: np.ndarray
    omega: np.ndarray
    last_frame: int


def estimate_initial_motion(
    positions: np.ndarray, times: np.ndarray, gravity: np.ndarray, ground: Ground | None, clearance: float
) -> InitialMotion:
    """Least squares on free flight.

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
    last = first_contact_frame(beyond_rigid(positions[: last + 1]))
    return InitialMotion(*free_flight(positions[: last + 1], times[: last + 1], gravity), last)
