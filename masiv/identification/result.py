"""The result of identify, for any kind of law."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from masiv.materials.law import Law
from masiv.models.initial_state import InitialState


@dataclass(frozen=True)
class IdentificationResult:
    """The identified law and the initial state (simulation frame) of the first recording.

    trajectory_error: mean distance [m] to the trajectories over all fitted frames. report: more numbers for the twin's
    ``fit``; names end in their unit. history: rows of the fit by iteration.
    """

    law: Law
    initial_state: InitialState
    contact: str
    trajectory_error: float
    report: dict[str, Any] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)
