"""Whether a motion tells stiffness, viscosity, drag, friction and restitution, in millimetres against the noise.

For each quantity: by how much a change of it that matters would change the motion that was observed (closed-form
estimates, of orders of magnitude), and the standard error with which the motion shows such a change (Cramér–Rao for
independent noise). Nothing is fitted.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from masiv.identifiability.drag import drag
from masiv.identifiability.grounded import friction, restitution
from masiv.identifiability.motion import ObservedMotion
from masiv.identifiability.shape_change import stiffness, viscosity
from masiv.identifiability.verdict import Answer

QUESTIONS = (stiffness, viscosity, drag, friction, restitution)


@dataclass(frozen=True)
class Identifiability:
    """Answers for one recording of one body."""

    recording: str
    answers: tuple[Answer, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"recording": self.recording, **{a.quantity: _plain(a) for a in self.answers}}

    def lines(self) -> list[str]:
        """One line a quantity."""
        return [f"  {answer.text()}" for answer in self.answers]


def identifiability(motion: ObservedMotion) -> Identifiability:
    """What ``motion`` will tell."""
    return Identifiability(motion.name, tuple(question(motion) for question in QUESTIONS))


def _plain(answer: Answer) -> dict[str, Any]:
    return {key: value for key, value in asdict(answer).items() if key != "quantity"}
