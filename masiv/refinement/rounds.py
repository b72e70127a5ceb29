"""What the search tried, round by round."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from masiv.inference.model_fit import ModelFit, common_samples, rank_by_bic
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Candidate, Ranking

MIN_BIC_GAP = 6.0
"""Difference of the information criterion below which two fits explain the data equally well."""
MIN_CONFUSABLE_SHARE = 0.02
"""Explained share below which an effect is confusable with none: its pattern is noise."""


@dataclass(frozen=True)
class Trial:
    """An effect that was fitted through the rollout, and the objections to it."""

    candidate: Candidate
    fitted: ModelFit
    objections: tuple[str, ...] = ()

    @property
    def effect(self) -> str:
        return self.candidate.effect

    @property
    def law(self) -> str:
        return self.fitted.model.family.kind

    @property
    def passes(self) -> bool:
        return not self.objections


@dataclass(frozen=True)
class Failure:
    """An effect that could not be simulated, with which law, and why."""

    effect: str
    law: str
    reason: str


@dataclass(frozen=True)
class Round:
    """One pass: what was tried on top of which model. trials: best first; accepted: one of them, or None.
    indistinguishable_from: effects that explain this motion as well as the accepted one.
    """

    base: ModelFit
    ranking: Ranking
    trials: tuple[Trial, ...]
    accepted: Trial | None
    confusable: dict[str, list[str]]
    indistinguishable_from: tuple[str, ...] = ()
    failures: tuple[Failure, ...] = ()

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        return self.ranking.candidates


@dataclass(frozen=True)
class SearchResult:
    """forward_model: with the observations, as whitened at the end, that all fits are compared with. before: the best
    model without effects. after: with what was accepted, ``before`` itself if nothing was. discrepancy: ``after`` with
    a smooth force for what is still unexplained, None if there is no need or no use."""

    forward_model: ForwardModel
    before: ModelFit
    after: ModelFit
    rounds: tuple[Round, ...]
    discrepancy: ModelFit | None = None


def rank_trials(trials: Sequence[Trial]) -> list[Trial]:
    """Best first by the information criterion."""
    place = {id(f): k for k, f in enumerate(rank_by_bic([t.fitted for t in trials]))}
    return sorted(trials, key=lambda t: place[id(t.fitted)])


def confusable(ranking: Ranking, trials: Sequence[Trial], min_correlation: float) -> dict[str, list[str]]:
    """Of each effect, those whose pattern in this data is nearly the same (``min_correlation``), or whose refit is as
    good."""
    out: dict[str, set[str]] = {c.effect: set() for c in ranking.candidates}
    for a in ranking.candidates:
        for b in ranking.candidates:
            seen = a.effect != b.effect and min(a.explained, b.explained) > MIN_CONFUSABLE_SHARE
            if seen and a.correlation(b) >= min_correlation:
                out[a.effect].add(b.effect)
    best: dict[str, float] = {}
    samples = common_samples([t.fitted for t in trials]) if trials else 0
    for t in trials:
        best[t.effect] = min(best.get(t.effect, math.inf), t.fitted.bic(samples))
    for a, bic_a in best.items():
        for b, bic_b in best.items():
            if a != b and abs(bic_a - bic_b) < MIN_BIC_GAP and a in out and b in out:
                out[a].add(b)
    return {name: sorted(others) for name, others in out.items()}


def similar_to_accepted(name: str, rounds: Sequence[Round]) -> dict[str, list[str]]:
    """What is like the term ``name`` in the round that accepted it: whose pattern is (confusable_with), and what may be
    there in its place (indistinguishable_from)."""
    accepting = [r for r in rounds if r.accepted is not None and r.accepted.effect == name]
    return {
        "confusable_with": accepting[0].confusable.get(name, []) if accepting else [],
        "indistinguishable_from": list(accepting[0].indistinguishable_from) if accepting else [],
    }
