"""Drag: how far it moves a body from its flight, beside what another start would do."""

from __future__ import annotations

import numpy as np

from masiv.identifiability.motion import ObservedMotion
from masiv.identifiability.verdict import YES, Answer, no, weighed

SPHERE = 0.47
"""Drag coefficient of a sphere between Reynolds numbers 10³ and 10⁵."""
FEWEST_FRAMES = 4
TALLEST = 30.0  # m, of a fall that somebody may film


def drag(motion: ObservedMotion) -> Answer:
    """The drag of the medium on a sphere of this size and mass, and the smallest that the flight shows."""
    name = "drag"
    if motion.clamped:
        return no(name, "the body is held, where drag cannot be told from its own damping", "a free flight")
    free = motion.flight
    count = free.stop
    if count < FEWEST_FRAMES:
        return no(name, f"it flies for {count} frames only, {FEWEST_FRAMES} are needed", "a longer flight")
    times, centre = motion.times[free] - motion.times[0], motion.centre[free]
    moves = rate_sensitivity(times, centre)
    norm = float(np.sqrt((moves**2).sum()))
    error = motion.centre_std / norm if norm > 0 else np.inf
    speed = float(np.linalg.norm(np.diff(centre, axis=0), axis=1).sum()) / float(times[-1])
    root = norm / np.sqrt(count)
    if not np.isfinite(error):
        return no(name, "it does not move", "a free flight")
    if motion.mass is None:
        rate, of = 1 / float(times[-1]) / 10, "one that takes a tenth of its speed during the flight"
    else:
        area = np.pi * motion.size**2 / 4
        rate = 0.5 * motion.medium_density * SPHERE * area * speed / motion.mass
        of = f"that of a medium of {motion.medium_density:.3g} kg/m³ at {speed:.2g} m/s"
    noise = motion.centre_std / np.sqrt(count)
    because = (
        f"{of} ({rate:.2g} /s) moves it by {1e3 * rate * root:.2g} mm in {times[-1]:.2g} s of flight (standard error "
        f"{1e3 * noise:.2g} mm); the least that shows is {YES * error:.2g} /s"
    )
    return weighed(name, rate * root, noise, because, _film(motion, YES * error / rate, times))


def rate_sensitivity(times: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Change (T, 3) [m s] of a flight by a drag a = −k v, per k at k = 0, beyond what another position and velocity at
    the start explain.

    The velocity changes by −k (x − x0), so the position by −k times the integral of x − x0.
    """
    way = centre - centre[0]
    steps = 0.5 * (way[1:] + way[:-1]) * np.diff(times)[:, None]
    moved = -np.concatenate([np.zeros((1, way.shape[1])), np.cumsum(steps, axis=0)])
    basis = np.stack([np.ones_like(times), times], axis=1)
    return moved - basis @ np.linalg.lstsq(basis, moved, rcond=None)[0]


def _film(motion: ObservedMotion, factor: float, times: np.ndarray) -> str:
    """A fall that shows a drag that is smaller by ``factor``. Its effect grows as the rate, which grows as the speed,
    times g T³: as T⁴, and with the number of frames."""
    gravity = float(np.linalg.norm(motion.gravity))
    duration = float(times[-1]) * max(factor, 1.0) ** (1 / 4.5)
    height = 0.5 * gravity * duration**2
    if 0 < height < TALLEST:
        return f"a fall of {height:.2g} m ({duration:.2g} s), or a lighter body of this size"
    return "a lighter body of this size: no fall that can be filmed shows it"
