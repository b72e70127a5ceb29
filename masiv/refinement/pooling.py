"""Several bodies that share physics: what do they lack together, and what does each by itself?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import MasivError
from masiv.identification.flights import fit_flights
from masiv.inference.model_fit import ModelFit, gauss_newton_fit
from masiv.inference.robust import robust_scale_of
from masiv.models.base import EffectTerm, Model
from masiv.models.point_mass import PointMassModel
from masiv.refinement.config import RefineConfig
from masiv.refinement.hypotheses import Posterior, linearized, weighed
from masiv.refinement.result import BodyResult, RefineResult, SharedFit
from masiv.refinement.rounds import SearchResult
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine


def refine_bodies(forward_model: PointMassModel, settings: SearchSettings) -> RefineResult:
    """Which effects do the flights of several bodies lack?

    An effect of the surroundings is one for all bodies. One that depends on the body is tried for all with one
    strength, for all with one each, and for each body alone. A strength is shared only if no body's held-out flight
    gets worse by it; of one strength each, a body keeps its own if its own flights confirm it.
    """
    more = len(forward_model.bodies)  # flights cost nothing: try all that a body may have of its own
    settings = replace(
        settings, max_effects=settings.max_effects + more, shortlist=settings.shortlist + 2 * more,
    )  # fmt: skip
    result = refine(forward_model, [fit_flights(forward_model)], settings)
    pool = _Pool(forward_model.with_observations(result.observations), result.search, settings.config)
    after, objections = pool.confirmed()
    confirmed = replace(result, search=replace(result.search, after=after))
    pool = replace(pool, search=confirmed.search)
    return replace(confirmed, bodies=pool.by_body(objections), shared=pool.shared())


@dataclass(frozen=True)
class _Pool:
    """The outcome of a search over several bodies, to be worked out for each by itself."""

    forward_model: PointMassModel
    search: SearchResult
    config: RefineConfig

    @property
    def robust_scale(self) -> float:
        """[m]"""
        before = self.search.before
        return robust_scale_of(self.forward_model.residual(before.model, before.values))

    def confirmed(self) -> tuple[ModelFit, dict[str, tuple[str, ...]]]:
        """The fit in which, of an effect with one strength each, only those bodies keep it whose own flights confirm
        it, by the rules of the search; and the objections of the others. Standard errors are from each body's own
        flights.
        """
        after, refused = self.search.after, {}
        for term in [self.forward_model.term(name) for name in after.model.effects]:
            if len(term.bodies) > 1:
                after, objections = self._confirmed_term(after, term)
                refused |= objections
        return (after if after.model.effects else self.search.before), refused

    def _confirmed_term(self, after: ModelFit, term: EffectTerm) -> tuple[ModelFit, dict[str, tuple[str, ...]]]:
        model, refused = self.forward_model, {}
        others = Model(after.model.family, "none", tuple(n for n in after.model.effects if n != term.name))
        kept, values, stderr = [], dict(after.values), {}
        for body in term.bodies:
            own = model.scoped_term(term.effect, (body,))
            # Not from zero: a fit that begins on a bound hardly leaves it.
            start = {
                p.name: max(after.values[q.name], p.step)
                for p, q in zip(own.parameters, model.parameters_of(term, body), strict=True)
            }
            single = self._fit_single_body(body, others, {**after.values, **start}, own)
            if isinstance(single, ModelFit):
                kept.append(own.name)
                values |= single.values
                stderr |= {p.name: single.stderr[p.name] for p in own.parameters}
            else:
                refused[body] = single
        richer = replace(others, effects=(*others.effects, *kept))
        budget = 3 * (len(model.parameters(richer)) + 1)
        fitted = gauss_newton_fit(model, richer, values, budget=budget, robust_scale=self.robust_scale)
        return replace(fitted, stderr={**fitted.stderr, **stderr}), refused

    def _fit_single_body(
        self, body: str, others: Model, values: Mapping[str, float], own: EffectTerm
    ) -> ModelFit | tuple[str, ...]:
        """The fit of ``own`` to the flights of ``body`` alone, or the objections to it."""
        one = self.forward_model.single_body(body, others, values)
        try:
            without = fit_flights(one, others, values)
            fitted = fit_flights(one, others.with_effect(own.name), values)
        except MasivError as failed:
            return (str(failed),)
        if why := one.impossible(fitted, own):
            return tuple(why)
        null, effect = weighed(one, [(f, linearized(one, f)) for f in (without, fitted)])
        p = Posterior.of([null, effect], 1).with_at_most(len(others.effects))
        if p >= self.config.max_null_probability:
            return (f"its own flights leave a probability of {p:.2g} that it does not act",)
        return effect.with_posterior()

    def by_body(self, objections: Mapping[str, tuple[str, ...]]) -> dict[str, BodyResult]:
        """Effects and held-out errors of each body."""
        model, before, after = self.forward_model, self.search.before, self.search.after
        terms = [model.term(n) for n in after.model.effects]
        was, now = (model.by_body(f.model, f.values, "hold_out") for f in (before, after))
        out = {}
        for body in model.bodies:
            effects = tuple(t.effect for t in terms if not t.bodies or body in t.bodies)
            out[body] = BodyResult(effects, was[body], now[body], objections.get(body, ()))
        return out

    def shared(self) -> tuple[SharedFit, ...]:
        """Effects accepted for two bodies or more, each refitted with one strength for those."""
        model, after, out = self.forward_model, self.search.after, []
        terms = [model.term(name) for name in after.model.effects]
        for effect in dict.fromkeys(t.effect for t in terms if t.bodies):
            parts = [t for t in terms if t.effect == effect]
            if len(parts) > 1:
                out.append(self._with_one_strength(effect, parts))
        return tuple(out)

    def _with_one_strength(self, effect: str, parts: list[EffectTerm]) -> SharedFit:
        model, after = self.forward_model, self.search.after
        one = model.scoped_term(effect, tuple(b for t in parts for b in t.bodies))
        kept = tuple(n for n in after.model.effects if model.term(n) not in parts)
        start = {
            p.name: float(np.mean([after.values[q.parameters[k].name] for q in parts]))
            for k, p in enumerate(one.parameters)
        }
        fitted = gauss_newton_fit(
            model, replace(after.model, effects=(*kept, one.name)), {**after.values, **start},
            budget=6 * (len(after.parameters) + 1), robust_scale=self.robust_scale,
        )  # fmt: skip
        strengths = [after.values[t.parameters[0].name] for t in parts if t.bodies]
        std = float(np.std(strengths, ddof=1)) if len(strengths) > 1 else math.nan
        each, shared = weighed(model, [(f, linearized(model, f)) for f in (after, fitted)])
        factor = shared.marginal.log_evidence - each.marginal.log_evidence
        return SharedFit(one, shared.with_posterior(), factor, std)
