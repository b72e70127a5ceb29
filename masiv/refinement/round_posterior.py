"""The posterior over the models of a round: those without one effect more, and those with it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from masiv.errors import MasivError, NonFiniteError
from masiv.inference.evidence import Evidence
from masiv.inference.linear_model import LinearModel
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, held_parameters
from masiv.refinement.hypotheses import (
    NEGLIGIBLE,
    Hypothesis,
    Linearized,
    Posterior,
    evidence_of,
    weighed,
)
from masiv.refinement.posterior_fit import linearized_at_mean
from masiv.refinement.refits import reasons_against, with_free_places
from masiv.refinement.rounds import Trial
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.workers import TaskError


@dataclass(frozen=True)
class RoundPosterior:
    """The posterior over models without one effect more and those of ``trials`` that can act; the trials with their
    evidence, most probable first. evidence: with the errors of all of them. at_mean: models that are linearised about
    the mean of their posterior, by the id of their fit."""

    posterior: Posterior
    trials: tuple[Trial, ...]
    evidence: Evidence
    at_mean: Mapping[int, LinearModel] = field(default_factory=dict)

    @classmethod
    def of(
        cls, state: SearchState, without: Sequence[ModelFit], trials: Sequence[Trial], settings: SearchSettings,
        at_mean: Mapping[int, LinearModel] = MappingProxyType({}),
    ) -> RoundPosterior:  # fmt: skip
        """Raises MasivError if none of the models ``without`` can be weighed: against what would an effect be
        probable?"""
        possible = [t for t in trials if not t.impossible]
        found = _weighed(state, without, [t.fitted for t in possible], settings, at_mean)
        fewer = len(state.fit.model.effects)
        simpler = [h.marginal.log_evidence for h in found.hypotheses if len(h.effects) == fewer]
        if not simpler:
            why = found.failed[id(state.fit)]
            raise MasivError(f"no model without a further effect can be weighed: {why}")
        known = {id(h.fitted): h.marginal.log_evidence - max(simpler) for h in found.hypotheses}
        weighed_trials = [
            replace(t, log_bayes_factor=known.get(id(t.fitted)), not_weighed=found.failed.get(id(t.fitted)))
            for t in trials
        ]
        weighed_trials.sort(key=lambda t: -math.inf if t.log_bayes_factor is None else t.log_bayes_factor, reverse=True)
        causes = settings.causes(state.forward_model, state.fit.model)
        shapes = {name: len(cause) for cause in causes for name in cause}
        posterior = Posterior.of(found.hypotheses, len(causes), shapes)
        return cls(posterior, tuple(weighed_trials), found.evidence, at_mean)

    def with_completed(
        self, state: SearchState, without: Sequence[ModelFit], trial: Trial, settings: SearchSettings
    ) -> RoundPosterior:  # fmt: skip
        """With ``trial`` fitted to the end. It and the models ``without`` its effect are weighed at the mean of their
        posterior."""
        at_mean = dict(self.at_mean)
        if not at_mean:
            for fit in without:
                with suppress(NonFiniteError):
                    at_mean[id(fit)] = self._at_mean(state, fit, settings)
        done, line = self._completed(state, trial, settings)
        if line is not None:
            at_mean[id(done.fitted)] = line
        trials = [done if t is trial else t for t in self.trials]
        return RoundPosterior.of(state, without, trials, settings, at_mean)

    def with_trial(
        self, state: SearchState, without: Sequence[ModelFit], trial: Trial, settings: SearchSettings
    ) -> RoundPosterior:
        """With one more ``trial``, whose fit has ended. Raises MasivError."""
        at_mean = dict(self.at_mean)
        with suppress(NonFiniteError):
            at_mean[id(trial.fitted)] = self._at_mean(state, trial.fitted, settings)
        return RoundPosterior.of(state, without, [*self.trials, trial], settings, at_mean)

    def _at_mean(self, state: SearchState, fit: ModelFit, settings: SearchSettings) -> LinearModel:
        """Raises NonFiniteError."""
        return linearized_at_mean(state.forward_model, fit, self.evidence, state.robust_scale, settings.linearizations)

    def _completed(
        self, state: SearchState, trial: Trial, settings: SearchSettings
    ) -> tuple[Trial, LinearModel | None]:
        """``trial`` fitted to the end, its places free if that pays, with the standard errors of its posterior; its
        model about the mean of that, None if it has no derivatives there."""
        model, start = state.forward_model, trial.fitted
        final = gauss_newton_fit(
            model, start.model, start.values, budget=2 * len(start.parameters) + 6, robust_scale=state.robust_scale,
            held=held_parameters(model, start),
        )  # fmt: skip
        best = with_free_places(state, min(final, start, key=lambda f: f.cost))
        try:
            line = self._at_mean(state, best, settings)
        except NonFiniteError as error:
            reason = f"at its best fit, {error}"
            return replace(trial, fitted=best, completed=True, impossible=(reason,)), None
        (hypothesis,) = weighed(model, [(best, line)], settings.workers, self.evidence)
        done = replace(trial, fitted=hypothesis.with_posterior(), completed=True)
        return replace(done, impossible=tuple(reasons_against(model, done.fitted, done.effect))), line


@dataclass(frozen=True)
class _Weighed:
    """hypotheses, with one evidence for all; failed: by the id of a fit, why it has no derivatives."""

    hypotheses: Sequence[Hypothesis]
    evidence: Evidence
    failed: Mapping[int, str]


def _weighed(
    state: SearchState, without: Sequence[ModelFit], fits: Sequence[ModelFit], settings: SearchSettings,
    at_mean: Mapping[int, LinearModel],
) -> _Weighed:  # fmt: skip
    """Hypotheses of ``without``, models without the effect that each of ``fits`` adds, and of ``fits``, but for those
    that have no derivatives over all instants. at_mean: linearised models, by the id of their fit. What is improbable
    with the derivatives of the model without the effect is not looked at more closely."""
    model, workers = state.forward_model, settings.workers
    bases, failed = _linearized(state, without, settings)
    left = [f for f in fits if id(f) not in at_mean]
    near = {id(f): next((line for other, line in bases if _extends(f, other)), None) for f in left}
    others, why = _linearized(state, [f for f in left if near[id(f)] is None], settings)
    rough = [f for f in left if near[id(f)] is not None]
    pairs = [(f, line) for f in rough if (line := near[id(f)]) is not None]
    lines = list(zip(rough, settings.linearizations.nearly(model, pairs), strict=True))
    failed |= why | {id(f): line.reason for f, line in lines if isinstance(line, TaskError)}
    known = [
        *((f, at_mean.get(id(f), line)) for f, line in bases), *others,
        *((f, line) for f, line in lines if not isinstance(line, TaskError)),
        *((f, at_mean[id(f)]) for f in fits if id(f) in at_mean),
    ]  # fmt: skip
    if not known:
        raise MasivError(f"no model can be weighed: {failed[id(state.fit)]}")
    evidence = evidence_of(model, known)
    found = weighed(model, known, workers, evidence)
    best = max(h.marginal.log_evidence for h in found)
    close = {
        id(h.fitted) for h in found
        if near.get(id(h.fitted)) is not None and h.marginal.log_evidence > best - NEGLIGIBLE
    }  # fmt: skip
    exact, why = _linearized(state, [f for f in rough if id(f) in close], settings)
    kept = [h for h in found if id(h.fitted) not in close]
    return _Weighed([*kept, *weighed(model, exact, workers, evidence)], evidence, failed | why)


def _extends(fit: ModelFit, base: ModelFit) -> bool:
    """Whether ``fit`` is ``base`` with an effect more."""
    one, other = fit.model, base.model
    return one.family == other.family and one.contact == other.contact and set(other.effects) < set(one.effects)


def _linearized(
    state: SearchState, fits: Sequence[ModelFit], settings: SearchSettings
) -> tuple[list[Linearized], dict[int, str]]:
    """``fits`` with their derivatives over all instants; of those that have none, by their id, why not."""
    label, kept, failed = "refine: weigh models", [], {}
    settings.progress(label, 0, len(fits))
    for done, (fit, line) in enumerate(zip(fits, settings.linearizations.each(state.forward_model, fits), strict=True)):
        settings.progress(label, done + 1, len(fits))
        if isinstance(line, TaskError):
            failed[id(fit)] = line.reason
        else:
            kept.append((fit, line))
    return kept, failed
