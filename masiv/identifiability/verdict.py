"""An answer: yes, doubtful or no, because of a number, and what to film instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.identifiability.motion import ObservedMotion

YES, DOUBTFUL = 3.0, 1.0
"""Standard errors by which the motion must change: three are seen, less than one is not."""


@dataclass(frozen=True)
class Answer:
    """verdict: yes, doubtful or no. signal_mm: by how much a change of the quantity would change the motion; noise_mm:
    its standard error; both None if the motion cannot show it. film: what to record instead, None for a yes."""

    quantity: str
    verdict: str
    signal_mm: float | None
    noise_mm: float | None
    because: str
    film: str | None

    def text(self) -> str:
        """``quantity: verdict, because …; film …``."""
        return f"{self.quantity}: {self.verdict}, because {self.because}" + (
            "" if not self.film else f"; film {self.film}"
        )


def no(quantity: str, because: str, film: str) -> Answer:
    """The motion cannot show it."""
    return Answer(quantity, "no", None, None, because, film)


def weighed(quantity: str, signal: float, noise: float, because: str, film: str, doubt: str | None = None) -> Answer:
    """By ``signal`` and ``noise`` [m]; a ``doubt`` that is no matter of noise turns a yes into doubtful."""
    z = signal / noise
    verdict = "yes" if z >= YES else "doubtful" if z >= DOUBTFUL else "no"
    if verdict == "yes" and doubt is not None:
        verdict, because = "doubtful", f"{because}, but {doubt}"
    return Answer(quantity, verdict, 1e3 * signal, 1e3 * noise, because, None if verdict == "yes" else film)


def mm(length: float) -> str:
    """``length`` [m] in millimetres, two digits."""
    value = 1e3 * length
    return f"{value:.0f} mm" if value >= 10 else f"{value:.2g} mm"


def velocity_at_contact(motion: ObservedMotion) -> tuple[np.ndarray, float] | None:
    """Velocity (3,) [m/s] of the centre at the first frame of contact, and the standard error [m/s] of a component, by
    the flight before it under gravity; None if fewer than two frames of flight are known."""
    free, contact = motion.flight, motion.contact
    if contact is None or free.stop < 2:
        return None
    times = motion.times[free]
    t = times - times[0]
    straight = motion.centre[free] - 0.5 * motion.gravity * t[:, None] ** 2
    start = np.polyfit(t, straight, 1)[0]
    error = motion.centre_std / float(np.sqrt(((t - t.mean()) ** 2).sum()))
    return start + motion.gravity * (motion.times[contact] - times[0]), error
