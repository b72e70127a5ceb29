"""Stiffness and viscosity of the material: they show only in what deforms."""

from __future__ import annotations

import numpy as np

from masiv.identifiability.motion import ObservedMotion
from masiv.identifiability.verdict import YES, Answer, mm, no, velocity_at_contact, weighed

FACTOR = 1 - 2**-0.5
"""By which the deformation of an elastic body in an impact changes if its modulus is twice as large: its kinetic energy
becomes k d² / 2."""
DAMPING_RATIO = 0.1
"""Typical of rubber and gels; soft tissue has more."""
LOST = 1 - float(np.exp(-np.pi * DAMPING_RATIO))
"""Part of its amplitude that a vibration with this damping loses in half a period."""
SPRUNG_BACK = 0.2
"""Part of the deformation that must go back before a body is called elastic (chosen)."""
LARGE = 0.3
"""Frames with more than this part of the largest deformation count as independent measurements of it."""
FEWEST_AFTER = 3  # frames after the largest deformation in which its return is seen
LONGER = "for 0.3 s or more after the impact"


def stiffness(motion: ObservedMotion) -> Answer:
    """A modulus that is twice as large against this one."""
    name = "stiffness"
    if not motion.shape.shape[1]:
        return no(name, "one marker shows no shape", "two or more markers on the body, away from a clamp")
    if not motion.clamped and motion.contact is None and motion.lowest is not None:
        if not _deforms(motion):
            return no(name, "the body touches nothing and keeps its shape within "
                      f"{mm(motion.deformation.max())} (noise {mm(motion.shape_std)})",
                      f"it hitting the ground, and {LONGER}")  # fmt: skip
    largest, noise = _largest(motion)
    film = f"a motion that deforms it by {mm(YES * noise / FACTOR)} or more, and {LONGER}{_height(motion, noise)}"
    because = f"the body deforms by {mm(largest)} (noise {mm(motion.shape_std)}), of which a modulus twice as large "
    because += f"changes {mm(FACTOR * largest)} (standard error {mm(noise)})"
    doubt = None
    if not motion.clamped:
        doubt = _does_not_return(motion)
        if doubt is not None:
            film = f"it {LONGER}, or a weaker impact, from which it springs back"
    return weighed(name, FACTOR * largest, noise, because, film, doubt)


def viscosity(motion: ObservedMotion) -> Answer:
    """Damping of a typical elastic body, or a flow twice as viscous, against none."""
    name = "viscosity"
    if not motion.shape.shape[1] or not _deforms(motion):
        return no(name, f"the body keeps its shape within {mm(motion.deformation.max(initial=0))} (noise "
                  f"{mm(motion.shape_std)})", "a motion that deforms it, as for stiffness")  # fmt: skip
    largest, noise = _largest(motion)
    peak = _peak(motion.deformation)
    if peak is None:
        first = 0 if motion.contact is None else motion.contact
        lasts = int((motion.deformation[first:] < 0.9 * largest).sum())
        doubt = None if lasts >= FEWEST_AFTER else f"the flow is over in {lasts} frames"
        because = f"it flows by {mm(largest)} in {lasts} frames, of which twice the viscosity changes about "
        because += f"{mm(FACTOR * largest)} (standard error {mm(noise)})"
        return weighed(name, FACTOR * largest, noise, because, "it at a higher frame rate", doubt)
    after = len(motion.times) - 1 - peak
    doubt = None if after >= FEWEST_AFTER else f"the recording ends {after} frames after a maximum of the deformation"
    because = f"a typical damping (ratio {DAMPING_RATIO}) takes {mm(LOST * largest)} of {mm(largest)} in half a period "
    because += f"(standard error {mm(noise)})"
    return weighed(name, LOST * largest, noise, because, f"a larger deformation, and {LONGER}", doubt)


def _largest(motion: ObservedMotion) -> tuple[float, float]:
    """The largest deformation [m] and its standard error: of the frames in which it is large, against those at rest."""
    size = motion.deformation
    count = max(1, int((size > LARGE * size.max()).sum()))
    rest = max(1, motion.flight.stop)
    return float(size.max()), motion.shape_std * float(np.sqrt(1 / count + 1 / rest))


def _deforms(motion: ObservedMotion) -> bool:
    return bool(motion.deformation.max(initial=0.0) > YES * motion.shape_std)


def _does_not_return(motion: ObservedMotion) -> str | None:
    """Why the observed deformation may be flow; None if it goes back."""
    size = motion.deformation
    if _peak(size) is not None:
        return None
    after = len(size) - 1 - int(size.argmax())
    if after < FEWEST_AFTER:
        return f"the recording ends {after} frames after the largest deformation"
    return "it does not spring back: it flows, which hides its stiffness"


def _peak(size: np.ndarray) -> int | None:
    """The frame of the first maximum of ``size`` (T,) from which ``SPRUNG_BACK`` of the largest goes back."""
    highest = np.maximum.accumulate(size)
    back = np.flatnonzero(highest - size > SPRUNG_BACK * highest.max())
    return int(size[: back[0]].argmax()) if len(back) else None


def _height(motion: ObservedMotion, noise: float) -> str:
    """From which height the body must fall: deformation grows as the speed of the impact."""
    hit = velocity_at_contact(motion)
    gravity = float(np.linalg.norm(motion.gravity))
    largest = float(motion.deformation.max())
    if hit is None or gravity == 0 or largest <= 0:
        return ""
    speed = float(np.linalg.norm(hit[0])) * YES * noise / (FACTOR * largest)
    return f", a fall from {speed**2 / (2 * gravity):.2g} m" if speed**2 / (2 * gravity) < 10 else ""
