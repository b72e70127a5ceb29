"""Whether a body that falls does so along the declared gravity: a wrong up axis, frame rate or unit shows here."""

from __future__ import annotations

import numpy as np

from masiv.identifiability.motion import FALL_FRAMES, acceleration

MAX_ANGLE_DEG = 30.0
"""Between fall and gravity. Chosen: a wrong axis has 90°, a wind of half of gravity 27°."""
MAX_FACTOR = 1.5
"""Between fall and gravity. Chosen: a frame rate that is wrong by a factor of 1.25 makes 1.56."""
STANDARD_ERRORS = 5.0
FEWEST_FLIGHT = 4
MAX_NOISE = 3.0
"""Times the noise that a parabola may leave."""


def fall_problem(times: np.ndarray, path: np.ndarray, noise: float, gravity: np.ndarray) -> str | None:
    """A sentence if the body flies at the beginning of ``path`` (T, 3) [m], known to ``noise`` [m], and does not fall
    along ``gravity`` (3,) [m/s²].

    It flies over the first frames, five or more, whose acceleration is constant within the noise and as large as
    gravity. This takes no ground, which would be wrong with the axis.
    """
    strength = float(np.linalg.norm(gravity))
    if strength == 0:
        return None
    found = None
    for count in range(FALL_FRAMES, len(times) + 1):
        fall, error, left = acceleration(times[:count], path[:count])
        if left > MAX_NOISE * noise:
            break
        found = fall, error * max(1.0, noise / max(left, 1e-12))
    if found is None:
        return None
    fall, error = found
    size = float(np.linalg.norm(fall))
    if size < STANDARD_ERRORS * error or size == 0:
        return None  # it rests, is held, or is not seen well enough
    angle = float(np.degrees(np.arccos(np.clip(fall @ gravity / (size * strength), -1, 1))))
    way = ", ".join(f"{x:.1f}" for x in fall)
    declared = ", ".join(f"{x:.1f}" for x in gravity + 0.0)
    slack = STANDARD_ERRORS * error / strength
    if angle > MAX_ANGLE_DEG and abs(size / strength - 1) < 0.25 + slack:
        return (
            f"the object falls by ({way}) ± {error:.1f} m/s², and gravity is ({declared}): correct up_axis or gravity "
            "in scene.yaml"
        )
    return None


def wrong_scale(times: np.ndarray, path: np.ndarray, noise: float, gravity: np.ndarray) -> str | None:
    """A sentence if ``path`` (T, 3) [m], all of it in flight and known to ``noise`` [m], is along ``gravity`` but much
    faster or slower."""
    strength = float(np.linalg.norm(gravity))
    if strength == 0 or len(times) < FEWEST_FLIGHT:
        return None
    fall, error, left = acceleration(times, path)
    error *= max(1.0, noise / max(left, 1e-12))
    along = float(fall @ gravity) / strength
    across = float(np.linalg.norm(fall - along * gravity / strength))
    low, high = along - STANDARD_ERRORS * error, along + STANDARD_ERRORS * error
    if across > 0.5 * abs(along) or (1 / MAX_FACTOR * strength < high and low < MAX_FACTOR * strength):
        return None
    return (
        f"in flight the object accelerates by {along:.3g} ± {error:.2g} m/s² along gravity, which is {strength:.3g}: "
        f"check fps (a factor of {np.sqrt(abs(strength / along)):.3g} would explain it), the unit of the poses, "
        "or gravity in scene.yaml"
    )
