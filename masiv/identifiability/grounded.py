"""Friction and restitution: they act while the body touches the ground."""

from __future__ import annotations

import numpy as np

from masiv.identifiability.motion import ObservedMotion
from masiv.identifiability.verdict import YES, Answer, mm, no, velocity_at_contact, weighed

FRICTION, REBOUND = 0.5, 0.5
"""Typical coefficients of friction and of restitution."""
FEWEST_AFTER = 3
"""Frames after the contact, at the least, from which a change of velocity is seen: two give one velocity. Chosen."""
SOFT = 0.05
"""Of its size: a body that deforms by more is no rigid one that rebounds. Chosen."""
STUCK = 0.1
"""Part of its sideways speed below which a body stands. Chosen."""
FALL = "a fall on the ground"


def friction(motion: ObservedMotion) -> Answer:
    """A coefficient of 0.5 against a ground without friction."""
    name = "friction"
    lacking = _no_contact(motion, name)
    if lacking is not None:
        return lacking
    contact = motion.contact
    hit = velocity_at_contact(motion)
    assert contact is not None
    if hit is None:
        return no(name, "it touches the ground from the beginning, so how fast it comes is not known",
                  "a throw that ends on the ground")  # fmt: skip
    velocity, error = hit
    after = float(motion.times[-1] - motion.times[contact])
    down = max(0.0, -float(velocity @ motion.normal))
    sideways = velocity + down * motion.normal if down else velocity - (velocity @ motion.normal) * motion.normal
    speed = float(np.linalg.norm(sideways))
    slowed = min(speed, FRICTION * (down + float(np.linalg.norm(motion.gravity)) * after))
    noise = float(np.hypot(motion.centre_std * np.sqrt(2), error * after))
    count = len(motion.times) - contact
    because = (
        f"it comes to the ground with {speed:.2g} m/s sideways, and a coefficient of {FRICTION} moves it by "
        f"{mm(slowed * after)} in the {after:.2g} s after (standard error {mm(noise)})"
    )
    needed = YES * noise / max(after, 0.3)
    film = f"a throw with {max(1.0, needed):.2g} m/s or more sideways, and the sliding after it"
    doubt = None
    if count < FEWEST_AFTER:
        doubt = f"the recording ends {count} frames later"
    elif speed > 0 and _speed_after(motion, sideways / speed) < STUCK * speed:
        doubt = "it stops at once, which gives a lower limit of the coefficient only"
    return weighed(name, slowed * after, noise, because, film, doubt)


def restitution(motion: ObservedMotion) -> Answer:
    """A rebound with half of the speed against none."""
    name = "restitution"
    lacking = _no_contact(motion, name)
    if lacking is not None:
        return lacking
    contact = motion.contact
    hit = velocity_at_contact(motion)
    assert contact is not None
    if hit is None:
        return no(name, "it touches the ground from the beginning", FALL)
    down = max(0.0, -float(hit[0] @ motion.normal))
    after = motion.times[contact:] - motion.times[contact]
    rise = float(np.max(REBOUND * down * after - 0.5 * np.linalg.norm(motion.gravity) * after**2))
    noise = motion.height_std
    because = (
        f"it hits the ground with {down:.2g} m/s, and with a coefficient of {REBOUND} it rises {mm(max(rise, 0.0))} in "
        f"the {after[-1]:.2g} s after (noise {mm(noise)})"
    )
    doubt = None
    if len(after) - 1 < FEWEST_AFTER:
        doubt = f"the recording ends {len(after) - 1} frames later"
    elif motion.shape.shape[1] and motion.deformation.max() > SOFT * motion.size:
        doubt = f"it deforms by {mm(motion.deformation.max())}, so its material decides the rebound, not the contact"
    return weighed(
        name, max(rise, 0.0), noise, because, f"{FALL} and the rebound, of a body that hardly deforms", doubt
    )


def _no_contact(motion: ObservedMotion, name: str) -> Answer | None:
    if motion.clamped:
        return no(name, "the body is held", "it hitting or sliding on the ground")
    if motion.lowest is None:
        return no(name, "no ground is declared (scene.yaml: ground)", f"{FALL}, and declare it")
    if motion.contact is None:
        return no(name, f"it stays {mm(float(motion.lowest.min()))} above the ground", FALL)
    return None


def _speed_after(motion: ObservedMotion, along: np.ndarray) -> float:
    """Speed [m/s] in the direction ``along`` (3,) in the last frames after the contact."""
    assert motion.contact is not None
    start = min(motion.contact + 1, len(motion.times) - 2)
    return abs(float(np.polyfit(motion.times[start:], motion.centre[start:] @ along, 1)[0]))
