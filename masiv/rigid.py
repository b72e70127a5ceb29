"""Motion of a body that keeps its shape: how far points leave it, and where they go on in free flight."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SUDDEN = 4.0
"""How much farther than in the frames before a body is from rigid when it has hit something."""


def beyond_rigid(positions: np.ndarray) -> np.ndarray:
    """Root mean square distance (T - 1,) [m] of positions (T, N, 3) [m] after the first from its best rigid motion."""
    start = positions[0] - positions[0].mean(0)
    out = []
    for later in positions[1:]:
        now = later - later.mean(0)
        turn = Rotation.align_vectors(now, start)[0]
        out.append(np.sqrt(((now - turn.apply(start)) ** 2).sum(1).mean()))
    return np.array(out)


def beyond_uniform(positions: np.ndarray) -> np.ndarray:
    """Root mean square distance (T - 1,) [m] of positions (T, N, 3) [m] after the first from its best affine map: what
    no rigid motion and no strain that is the same everywhere explains."""
    start = np.column_stack([positions[0] - positions[0].mean(0), np.ones(positions.shape[1])])
    basis = np.linalg.qr(start)[0]
    return np.array([np.sqrt(((p - basis @ (basis.T @ p)) ** 2).sum(1).mean()) for p in positions[1:]])


def still_rigid(distances: np.ndarray) -> int:
    """How many of the frames with these ``beyond_rigid`` pass before the body hits something; at least two are taken to
    be free, if there are as many."""
    for frame in range(2, len(distances)):
        if distances[frame] > SUDDEN * np.median(distances[:frame]):
            return frame
    return len(distances)


def free_flight(positions: np.ndarray, times: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] at the first of ``times`` (T,) [s] of a body that
    flies at positions (T, N, 3) [m], T >= 2: least squares on x(t) = c + v t + g t^2 / 2 + exp([omega] t) (x0 - c)."""
    t = times[1:] - times[0]
    centres = positions.mean(1)
    # Fall is known, so that what is left is linear in time; late frames tell more of a velocity: least squares through
    # 0.
    drift = centres[1:] - centres[0] - 0.5 * gravity * t[:, None] ** 2
    arms = positions[0] - centres[0]
    turns = np.stack(
        [Rotation.align_vectors(p - c, arms)[0].as_rotvec() for p, c in zip(positions[1:], centres[1:], strict=True)]
    )
    return (t[:, None] * drift).sum(0) / (t**2).sum(), (t[:, None] * turns).sum(0) / (t**2).sum()


def flown(start: np.ndarray, velocity: np.ndarray, omega: np.ndarray, gravity: np.ndarray, time: float) -> np.ndarray:
    """Where points ``start`` (N, 3) [m] of a body are after ``time`` [s] of the flight that ``free_flight`` finds."""
    centre = start.mean(0)
    turned = Rotation.from_rotvec(omega * time).apply(start - centre)
    return centre + velocity * time + 0.5 * gravity * time**2 + turned


def struck(positions: np.ndarray, times: np.ndarray, gravity: np.ndarray) -> np.ndarray | None:
    """Where (3,) [m] a body in free flight at positions (T, N, 3) [m] first hit something: the place that the hundredth
    of its points that are then farthest from their flight would have reached. None where it flies all the time."""
    last = still_rigid(beyond_rigid(positions))
    if last + 1 >= len(positions):
        return None
    velocity, omega = free_flight(positions[: last + 1], times[: last + 1], gravity)
    due = flown(positions[0], velocity, omega, gravity, float(times[last + 1] - times[0]))
    missed = np.linalg.norm(positions[last + 1] - due, axis=1)
    return due[missed >= np.quantile(missed, 0.99)].mean(0)
