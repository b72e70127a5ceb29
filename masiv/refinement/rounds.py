"""What the search tried, round by round."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from masiv.inference.model_fit import ModelFit, rank_by_bic
from masiv.inference.predictive import Forecast
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Candidate, Ranking
from masiv.refinement.hypotheses import CREDIBLE, Posterior
from masiv.refinement.limits import UpperLimit


@dataclass(frozen=True)
class Trial:
    """An effect that was fitted through the rollout. impossible: why it cannot act as fitted, or cannot be told from a
    simpler one. converged: False if the fit did not reach what the ranking promised: that says nothing against the
    effect. log_bayes_factor: of its model against the best one with an effect fewer; None if it was not worked out.
    not_weighed: why it could not be worked out. completed: it was fitted to the end, its places free if that pays."""

    candidate: Candidate
    fitted: ModelFit
    impossible: tuple[str, ...] = ()
    converged: bool = True
    log_bayes_factor: float | None = None
    not_weighed: str | None = None
    completed: bool = False

    @property
    def effect(self) -> str:
        return self.candidate.effect

    @property
    def law(self) -> str:
        return self.fitted.model.family.kind


@dataclass(frozen=True)
class Failure:
    """An effect that could not be simulated, with which law, and why."""

    effect: str
    law: str
    reason: str


@dataclass(frozen=True)
class Exchange:
    """``new`` acts in place of the effect ``old``, which was accepted when others were still missing.
    log_bayes_factor: for that."""

    old: str
    new: str
    log_bayes_factor: float


@dataclass(frozen=True)
class Round:
    """One pass: what was tried on top of which model. trials: most probable first; accepted: one of them, or None.
    posterior: over the models with and without one effect more, None if none was fitted. exchanges: of effects that
    were accepted before, with the one accepted here."""

    base: ModelFit
    ranking: Ranking
    trials: tuple[Trial, ...]
    accepted: Trial | None
    posterior: Posterior | None = None
    failures: tuple[Failure, ...] = ()
    exchanges: tuple[Exchange, ...] = ()

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        return self.ranking.candidates


@dataclass(frozen=True)
class Check:
    """p: probability of a residual as large as that of a model, see ``predictive_p``. test: what the model says of the
    instants of the test, None if there are none."""

    p: float
    test: Forecast | None = None


@dataclass(frozen=True)
class SearchResult:
    """forward_model: with the observations, as whitened at the end, that all fits are compared with. before: the best
    model without effects. after: with what was accepted, ``before`` itself if nothing was. null_probability: that no
    effect of the library acts; unknown_probability: that something else does, with or without ``after``'s effects.
    checks: of ``before`` and ``after``; empty if effects were only ranked. limits: of effects that were not accepted.
    discrepancy: ``after`` with a smooth force for what is still unexplained, None if there is no need or no use.
    whitened_before: with the observations as whitened for ``before``; None: as ``forward_model``."""

    forward_model: ForwardModel
    before: ModelFit
    after: ModelFit
    rounds: tuple[Round, ...]
    null_probability: float = 1.0
    unknown_probability: float = 0.0
    checks: Mapping[str, Check] = field(default_factory=dict)
    limits: tuple[UpperLimit, ...] = ()
    discrepancy: ModelFit | None = None
    whitened_before: ForwardModel | None = None


def rank_trials(trials: Sequence[Trial]) -> list[Trial]:
    """Best first by the information criterion, before evidence is worked out."""
    place = {id(f): k for k, f in enumerate(rank_by_bic([t.fitted for t in trials]))}
    return sorted(trials, key=lambda t: place[id(t.fitted)])


def alternatives(name: str, after: ModelFit, rounds: Sequence[Round]) -> dict[str, float]:
    """Effects that may act in place of the accepted term ``name``, with the probability of the set that has them: of
    the credible set of the last round that accepted anything."""
    accepting = [r for r in rounds if r.accepted is not None and r.posterior is not None]
    if not accepting or accepting[-1].posterior is None:
        return {}
    rest = frozenset(after.model.effects) - {name}
    out = {}
    for effects, p in accepting[-1].posterior.credible_set().items():
        if len(effects) == len(rest) + 1 and rest <= effects and name not in effects:
            (other,) = effects - rest
            out[other] = p
    for exchange in (x for r in accepting for x in r.exchanges):
        p = 1 / (1 + math.exp(min(exchange.log_bayes_factor, 700.0)))
        if exchange.new == name and p > 1 - CREDIBLE:
            out[exchange.old] = p
    return out
