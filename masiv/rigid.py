"""Motion of a body that keeps its shape: how far points leave it, and where they go on in free flight."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

SUDDEN = 4.0
"""How much farther than in the frames before a body is from rigid when it has hit something."""
LARGEST_TURN = 0.05
"""[rad], in a step of a turn that is worked out."""


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


def first_contact_frame(distances: np.ndarray) -> int:
    """How many of the frames with these ``beyond_rigid`` pass before the body hits something; at least two are taken to
    be free, if there are as many."""
    for frame in range(2, len(distances)):
        if distances[frame] > SUDDEN * np.median(distances[:frame]):
            return frame
    return len(distances)


def free_flight(positions: np.ndarray, times: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] at the first of ``times`` (T,) [s] of a body that
    flies at positions (T, N, 3) [m], T >= 2: least squares on ``ballistic_positions``."""
    t = times[1:] - times[0]
    centres = positions.mean(1)
    # Fall is known, so that what is left is linear in time; late frames tell more of a velocity: least squares through
    # 0.
    drift = centres[1:] - centres[0] - 0.5 * gravity * t[:, None] ** 2
    arms = positions[0] - centres[0]
    turns = [Rotation.align_vectors(p - c, arms)[0] for p, c in zip(positions[1:], centres[1:], strict=True)]
    steady = (t[:, None] * np.stack([turn.as_rotvec() for turn in turns])).sum(0) / (t**2).sum()

    def missed(omega: np.ndarray) -> np.ndarray:
        pairs = zip(turns, turned_freely(positions[0], omega, t), strict=True)
        return np.concatenate([(seen * due.inv()).as_rotvec() for seen, due in pairs])

    return (t[:, None] * drift).sum(0) / (t**2).sum(), least_squares(missed, steady).x


def turned_freely(start: np.ndarray, omega: np.ndarray, times: np.ndarray) -> list[Rotation]:
    """How a rigid body, its mass even over ``start`` (N, 3) [m], has turned at ``times`` (T,) [s], ascending, after a
    spin of ``omega`` (3,) [rad/s]: Euler's equations, by the midpoint rule. No torque keeps its angular momentum, not
    its spin: a long body wobbles."""
    arms = start - start.mean(0)
    spread = arms.T @ arms
    inertia = np.trace(spread) * np.eye(3) - spread
    inertia += 1e-9 * np.trace(inertia) * np.eye(3)  # of points on a line, about the line
    inverse, momentum = np.linalg.inv(inertia), inertia @ omega
    turn, now, out = Rotation.identity(), 0.0, []
    for time in times:
        steps = max(1, math.ceil(np.linalg.norm(omega) * (time - now) / LARGEST_TURN))
        h = (time - now) / steps
        for _ in range(steps):
            half = Rotation.from_rotvec(0.5 * h * _spin(turn, inverse, momentum)) * turn
            turn = Rotation.from_rotvec(h * _spin(half, inverse, momentum)) * turn
        now = time
        out.append(turn)
    return out


def _spin(turn: Rotation, inverse: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """omega (3,) of a body that has turned, from the inverse of its inertia before that and its angular momentum."""
    return turn.apply(inverse @ turn.inv().apply(momentum))


def ballistic_positions(
    start: np.ndarray, velocity: np.ndarray, omega: np.ndarray, gravity: np.ndarray, time: float
) -> np.ndarray:
    """Where points ``start`` (N, 3) [m] of a body, its mass even over them, are after ``time`` [s] of free flight:
    x(t) = c + v t + g t^2 / 2 + R(t) (x0 - c), R of ``turned_freely``."""
    centre = start.mean(0)
    turned = turned_freely(start, omega, np.array([time]))[0].apply(start - centre)
    return centre + velocity * time + 0.5 * gravity * time**2 + turned


def impact_point(positions: np.ndarray, times: np.ndarray, gravity: np.ndarray) -> np.ndarray | None:
    """Where (3,) [m] a body in free flight at positions (T, N, 3) [m] first hit something: the place that the hundredth
    of its points that are then farthest from their flight would have reached. None where it flies all the time."""
    last = first_contact_frame(beyond_rigid(positions))
    if last + 1 >= len(positions):
        return None
    velocity, omega = free_flight(positions[: last + 1], times[: last + 1], gravity)
    due = ballistic_positions(positions[0], velocity, omega, gravity, float(times[last + 1] - times[0]))
    missed = np.linalg.norm(positions[last + 1] - due, axis=1)
    return due[missed >= np.quantile(missed, 0.99)].mean(0)
