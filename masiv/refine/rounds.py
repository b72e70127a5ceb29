"""What the loop tried, round by round."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from masiv.inference.model_fit import ModelFit
from masiv.refine.candidates import Candidate, alike

TELLS_APART = 6.0
"""Difference of the information criterion below which two refits explain the data equally well."""


@dataclass
class Trial:
    """An effect that was fitted through the rollout, and why it was or was not accepted."""

    candidate: Candidate
    fitted: ModelFit
    reasons: list[str] = field(default_factory=list)

    @property
    def passes(self) -> bool:
        return not self.reasons


@dataclass
class Round:
    """One pass: what was tried on top of which model. or_else: effects that may as well be there in place of the
    accepted one, as far as this motion tells."""

    base: ModelFit
    candidates: list[Candidate]
    trials: list[Trial]
    accepted: Trial | None
    confusable: dict[str, list[str]]
    indistinguishable_from: list[str] = field(default_factory=list)


def confusable(ranking: Sequence[Candidate], trials: Sequence[Trial], least: float) -> dict[str, list[str]]:
    """Of each effect, those whose pattern in this data is nearly the same (correlation ``least``), or whose refit is as
    good."""
    out: dict[str, set[str]] = {c.effect: set() for c in ranking}
    for a in ranking:
        for b in ranking:
            if a.effect != b.effect and min(a.explained, b.explained) > 0.02 and alike(a, b) >= least:
                out[a.effect].add(b.effect)
    best: dict[str, float] = {}
    samples = min((t.fitted for t in trials), key=lambda f: f.cost).samples if trials else 0
    for t in trials:
        best[t.candidate.effect] = min(best.get(t.candidate.effect, math.inf), t.fitted.bic(samples))
    for a, bic_a in best.items():
        for b, bic_b in best.items():
            if a != b and abs(bic_a - bic_b) < TELLS_APART and a in out and b in out:
                out[a].add(b)
    return {name: sorted(others) for name, others in out.items()}


def like_accepted(name: str, rounds: Sequence[Round]) -> dict[str, list[str]]:
    """What is like the term ``name`` in the round that accepted it: whose pattern is (confusable_with), and what may as
    well be there in its place (or_else)."""
    found = [r for r in rounds if r.accepted is not None and r.accepted.candidate.effect == name]
    return {
        "confusable_with": found[0].confusable.get(name, []) if found else [],
        "or_else": found[0].indistinguishable_from if found else [],
    }
