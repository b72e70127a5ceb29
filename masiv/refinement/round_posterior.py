"""The posterior over the models of a round: those without one effect more, and those with it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from masiv.errors import MasivError, NonFiniteError
from masiv.inference.evidence import Evidence
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, held_parameters
from masiv.refinement import savage_dickey
from masiv.refinement.hypotheses import (
    NEGLIGIBLE,
    Hypothesis,
    Linearized,
    Posterior,
    evidence_of,
    weighed,
)
from masiv.refinement.other_grids import log_mean_evidence
from masiv.refinement.posterior_fit import linearized_at_mean
from masiv.refinement.refits import reasons_against, with_free_places
from masiv.refinement.rounds import Trial
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.workers import TaskError

RESTART_DERIVATIVES = 2
"""Jacobians that the fit of a model without an effect may take from where the fit with it ended."""


@dataclass(frozen=True)
class RoundPosterior:
    """The posterior over models without one effect more and those of ``trials`` that can act; the trials with their
    evidence, most probable first. hypotheses: by the id of their fit. evidence: with the errors of the best of them at
    the start of the round. failed: by the id of a fit, why it has no derivatives. at_mean: whether models without the
    effect are linearised about the mean of their posterior."""

    posterior: Posterior
    trials: tuple[Trial, ...]
    evidence: Evidence
    hypotheses: Mapping[int, Hypothesis]
    failed: Mapping[int, str]
    at_mean: bool = False

    @classmethod
    def of(
        cls, state: SearchState, without: Sequence[ModelFit], trials: Sequence[Trial], settings: SearchSettings
    ) -> RoundPosterior:
        """Raises MasivError if none of the models ``without`` can be weighed: against what would an effect be
        probable?"""
        possible = [t.fitted for t in trials if not t.impossible]
        evidence, hypotheses, failed = _weighed(state, without, possible, settings)
        return cls._judging(state, trials, settings, evidence, hypotheses, failed)

    @classmethod
    def _judging(
        cls, state: SearchState, trials: Sequence[Trial], settings: SearchSettings, evidence: Evidence,
        hypotheses: Mapping[int, Hypothesis], failed: Mapping[int, str], *, at_mean: bool = False,
    ) -> RoundPosterior:  # fmt: skip
        fewer = len(state.fit.model.effects)
        can_act = {id(t.fitted) for t in trials if not t.impossible}
        kept = {k: h for k, h in hypotheses.items() if len(h.effects) == fewer or k in can_act}
        weighed = _with_nested(state, kept, fewer)
        simpler = [h.marginal.log_evidence for h in weighed.values() if len(h.effects) == fewer]
        if not simpler:
            raise MasivError(f"no model without a further effect can be weighed: {failed[id(state.fit)]}")
        factors = {k: h.marginal.log_evidence - max(simpler) for k, h in weighed.items()}
        judged = [
            replace(t, log_bayes_factor=factors.get(id(t.fitted)), not_weighed=failed.get(id(t.fitted))) for t in trials
        ]
        judged.sort(key=lambda t: -math.inf if t.log_bayes_factor is None else t.log_bayes_factor, reverse=True)
        causes = settings.causes(state.forward_model, state.fit.model)
        shapes = {name: len(cause) for cause in causes for name in cause}
        posterior = Posterior.of(list(weighed.values()), len(causes), shapes)
        return cls(posterior, tuple(judged), evidence, kept, failed, at_mean)

    def with_completed(
        self, state: SearchState, without: Sequence[ModelFit], trial: Trial, settings: SearchSettings
    ) -> RoundPosterior:  # fmt: skip
        """With ``trial`` fitted to the end, its places free if that pays."""
        model, start = state.forward_model, trial.fitted
        final = gauss_newton_fit(
            model, start.model, start.values, budget=2 * len(start.parameters) + 6, robust_scale=state.robust_scale,
            held=held_parameters(model, start),
        )  # fmt: skip
        best = with_free_places(state, min(final, start, key=lambda f: f.cost))
        done = replace(trial, fitted=best, completed=True)
        return self.with_ended(state, without, done, [t for t in self.trials if t is not trial], settings)

    def with_ended(
        self, state: SearchState, without: Sequence[ModelFit], trial: Trial, others: Sequence[Trial],
        settings: SearchSettings,
    ) -> RoundPosterior:  # fmt: skip
        """With ``trial``, whose fit has ended, beside ``others``. It gets the standard errors of its posterior. It and
        the models ``without`` its effect are weighed at the mean of their posterior."""
        hypotheses = dict(self.hypotheses)
        for fit in () if self.at_mean else without:
            if id(fit) in hypotheses:
                hypotheses[id(fit)] = self._at_mean(state, fit, settings)
        try:
            found = self._at_mean(state, trial.fitted, settings)
        except NonFiniteError as error:
            done = replace(trial, impossible=(f"at its best fit, {error}",))
        else:
            fitted = found.with_posterior()
            reasons = reasons_against(state.forward_model, fitted, trial.effect)
            done = replace(trial, fitted=fitted, impossible=tuple(reasons))
            hypotheses[id(fitted)] = replace(found, fitted=fitted)
        return self._judging(state, [done, *others], settings, self.evidence, hypotheses, self.failed, at_mean=True)

    def with_restarted(self, state: SearchState, trial: Trial, settings: SearchSettings) -> RoundPosterior:
        """With the model without the effect of ``trial`` fitted again from where that ended: what a restart alone
        explains is no evidence for an effect. Of the fits of a model the most probable one counts; one that did not
        end nearer to the observations is not looked at."""
        model, known = state.forward_model, trial.fitted
        simpler = replace(known.model, effects=tuple(n for n in known.model.effects if n != trial.effect))
        parameters = model.parameters(simpler)
        start = {p.name: known.values.get(p.name, state.fit.values.get(p.name, p.start)) for p in parameters}
        held = held_parameters(model, known) & start.keys()
        before = min((h.fitted.cost for h in self.hypotheses.values() if h.fitted.model == simpler), default=math.inf)
        try:
            again = gauss_newton_fit(
                model, simpler, start, budget=RESTART_DERIVATIVES * (len(parameters) + 2),
                robust_scale=state.robust_scale, held=held,
            )  # fmt: skip
            if again.cost >= before:
                return self
            found = self._at_mean(state, again, settings)
        except MasivError:
            return self
        hypotheses = {**self.hypotheses, id(again): found}
        return self._judging(
            state, self.trials, settings, self.evidence, hypotheses, self.failed, at_mean=self.at_mean
        )  # fmt: skip

    def with_other_grids(self, state: SearchState, trial: Trial, settings: SearchSettings) -> RoundPosterior:
        """With no more evidence for the effect of ``trial`` than there is if its model, and the most probable one
        without it, may be simulated on finer grids as well. As it is if the forward model has none."""
        model, fewer = state.forward_model, len(state.fit.model.effects)
        if not any(e.grid_corrections for e in model.observations):
            return self
        with_it, without = self.hypotheses.get(id(trial.fitted)), self.posterior.best(fewer)
        if with_it is None or without is None:
            return self
        try:
            factor = log_mean_evidence(model, with_it, self.evidence)
            factor -= log_mean_evidence(model, without, self.evidence)
        except MasivError:
            return self
        least = with_it.marginal.log_evidence - factor
        if least <= without.marginal.log_evidence:
            return self
        raised = replace(without, marginal=replace(without.marginal, log_evidence=least))
        hypotheses = {**self.hypotheses, id(without.fitted): raised}
        return self._judging(
            state, self.trials, settings, self.evidence, hypotheses, self.failed, at_mean=self.at_mean
        )  # fmt: skip

    def _at_mean(self, state: SearchState, fit: ModelFit, settings: SearchSettings) -> Hypothesis:
        """Raises NonFiniteError if ``fit`` has no derivatives."""
        model = state.forward_model
        line = linearized_at_mean(model, fit, self.evidence, state.robust_scale, settings.linearizations)
        (found,) = weighed(model, [(fit, line)], settings.workers, self.evidence)
        return found


def _with_nested(state: SearchState, hypotheses: Mapping[int, Hypothesis], fewer: int) -> dict[int, Hypothesis]:
    """``hypotheses``, those of ``fewer`` effects with no less evidence than the posterior of a model with one more, of
    the same law, leaves them."""
    out = dict(hypotheses)
    for h in hypotheses.values():
        if len(h.effects) <= fewer:
            continue
        for k, simpler in hypotheses.items():
            added = h.effects - simpler.effects
            if len(simpler.effects) != fewer or len(added) != 1 or simpler.law != h.law:
                continue
            (name,) = added
            least = h.marginal.log_evidence - savage_dickey.log_bayes_factor(h, state.forward_model.term(name))
            if least > out[k].marginal.log_evidence:
                out[k] = replace(simpler, marginal=replace(simpler.marginal, log_evidence=least))
    return out


def _weighed(
    state: SearchState, without: Sequence[ModelFit], fits: Sequence[ModelFit], settings: SearchSettings
) -> tuple[Evidence, dict[int, Hypothesis], dict[int, str]]:
    """Hypotheses of ``without``, models without the effect that each of ``fits`` adds, and of ``fits``, by the id of
    the fit, with one evidence for all; of those that have no derivatives over all instants, why not. What is improbable
    with the derivatives of the model without the effect is not looked at more closely. Raises MasivError."""
    model, workers = state.forward_model, settings.workers
    bases, failed = _linearized(state, without, settings)
    near = {id(f): next((line for other, line in bases if _extends(f, other)), None) for f in fits}
    others, why = _linearized(state, [f for f in fits if near[id(f)] is None], settings)
    rough = [f for f in fits if near[id(f)] is not None]
    pairs = [(f, line) for f in rough if (line := near[id(f)]) is not None]
    lines = list(zip(rough, settings.linearizations.nearly(model, pairs), strict=True))
    failed |= why | {id(f): line.reason for f, line in lines if isinstance(line, TaskError)}
    known = [*bases, *others, *((f, line) for f, line in lines if not isinstance(line, TaskError))]
    if not known:
        raise MasivError(f"no model can be weighed: {failed[id(state.fit)]}")
    evidence = evidence_of(model, known)
    found = {id(h.fitted): h for h in weighed(model, known, workers, evidence)}
    best = max(h.marginal.log_evidence for h in found.values())
    close = [f for f in rough if id(f) in found and found[id(f)].marginal.log_evidence > best - NEGLIGIBLE]
    exact, why = _linearized(state, close, settings)
    for f in close:
        del found[id(f)]
    found |= {id(h.fitted): h for h in weighed(model, exact, workers, evidence)}
    return evidence, found, failed | why


def _extends(fit: ModelFit, base: ModelFit) -> bool:
    """Whether ``fit`` is ``base`` with an effect more."""
    one, other = fit.model, base.model
    return one.family == other.family and one.contact == other.contact and set(other.effects) < set(one.effects)


def _linearized(
    state: SearchState, fits: Sequence[ModelFit], settings: SearchSettings
) -> tuple[list[Linearized], dict[int, str]]:
    """``fits`` with their derivatives over all instants; of those that have none, by their id, why not."""
    if not fits:
        return [], {}
    label, kept, failed = "refine: weigh models", [], {}
    settings.progress(label, 0, len(fits))
    for done, (fit, line) in enumerate(zip(fits, settings.linearizations.each(state.forward_model, fits), strict=True)):
        settings.progress(label, done + 1, len(fits))
        if isinstance(line, TaskError):
            failed[id(fit)] = line.reason
        else:
            kept.append((fit, line))
    return kept, failed
