"""What identify found, whatever the kind of law."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from masiv.identify.fit import Fit
from masiv.materials.law import Law
from masiv.models.initial_state import InitialState


@dataclass(frozen=True)
class Found:
    """A law and a throw (simulation frame); error_m: mean distance [m] to the trajectories over all fitted frames.

    report: more numbers for the twin's ``fit``, by names that end in their unit.
    """

    law: Law
    motion: InitialState
    contact: str
    error_m: float
    report: dict[str, Any] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)


def history_rows(fit: Fit) -> list[dict[str, float]]:
    """The history of a fit, for people."""
    return [
        {"iteration": i, "frames": k, "trajectory_error_mm": 1e3 * e, "silhouette": s} for i, k, e, s in fit.history
    ]
