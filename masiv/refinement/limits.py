"""Upper limits of effects that were not accepted: how strong they may be without having been seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.inference.evidence import Evidence, strength_scales
from masiv.inference.linear_model import LinearModel, linear_model
from masiv.inference.marginal_likelihood import Marginal
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.effect_fit import absent
from masiv.refinement.hypotheses import Hypothesis

LEVEL = 0.95
"""Probability that a strength is below its limit."""
DRAWS = 2000


@dataclass(frozen=True)
class UpperLimit:
    """strength: 95 % upper limit of the size of an effect's strength, in its unit. motion_mm: root mean square change
    of the observed motion that it makes at that limit. determined: whether the limit is below the middle of the sizes
    that are likely beforehand: if not, the recording says little of the effect. log_bayes_factor: for the effect, of
    the linear model. reason: why there is no limit, None if there is one."""

    effect: str
    strength: float
    motion_mm: float
    determined: bool
    log_bayes_factor: float
    reason: str | None = None

    @classmethod
    def unknown(cls, effect: str, reason: str) -> UpperLimit:
        """Of an effect whose strength this recording does not limit."""
        return cls(effect, math.inf, 0.0, False, 0.0, reason)


def sensitivity(
    forward_model: ForwardModel, at: LinearModel, name: str, places: dict[str, float]
) -> tuple[dict[str, float], LinearModel]:
    """Values of the model ``at`` with the effect absent, and its derivatives by the effect's strengths. Raises
    NonFiniteError."""
    term = forward_model.term(name)
    values = {**absent(term, at.values), **{p.name: places.get(p.name, p.start) for p in term.others}}
    fields = None if term.replaces_parameter else at.fields  # the effect is absent, and nothing else is in its place
    return values, linear_model(forward_model, at.model.with_effect(name), values, term.strengths, fields)


def extended(at: LinearModel, term: EffectTerm, values: dict[str, float], columns: LinearModel) -> LinearModel:
    """``at`` with ``term``, of which ``columns`` are the derivatives at ``values``, see ``sensitivity``; without the
    parameters that it replaces."""
    joined = at.with_parameters(columns.model, values, columns)
    own = {p.name for p in columns.parameters}  # gravity is known to a part without being an effect
    gone = {p.name for p in at.parameters} & own
    kept = [
        k
        for k, p in enumerate(joined.parameters)
        if p.name not in term.replaces_parameter and (k >= len(at.parameters) or p.name not in gone)
    ]
    return replace(
        joined,
        parameters=tuple(joined.parameters[k] for k in kept),
        jacobians=[j[..., kept] for j in joined.jacobians],
    )


def upper_limit(
    evidence: Evidence, at: LinearModel, terms: Sequence[EffectTerm], term: EffectTerm, here: Marginal,
    found: tuple[dict[str, float], LinearModel], least: float = 0.0,
) -> UpperLimit:  # fmt: skip
    """The limit of ``term`` in addition to the model ``at``, with the effects ``terms`` and the evidence ``here``; not
    below ``least``."""
    columns = found[1]
    joined = extended(at, term, *found)
    whole = evidence.marginal(joined, [*terms, term], near=here)
    priors = evidence.priors(joined, [*terms, term])
    names = [p.name for p in joined.parameters]
    # Along axes that were not measured nothing is seen.
    seen = [k for k in range(len(term.strengths)) if any(j[..., k].any() for j in columns.jacobians)]
    if not seen:
        return UpperLimit.unknown(term.name, "it moves nothing along the axes that were measured")
    index = [names.index(term.strengths[k].name) for k in seen]
    # Of the widest prior of the strength: the limit is what the data say.
    wide = evidence.marginal_with(joined, replace(priors, precision=priors.precision[-1:]), near=here)
    mean, covariance = wide.mean[index], wide.covariance[np.ix_(index, index)]
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, DRAWS, method="eigh")
    possible = (draws >= np.array([term.strengths[k].lower for k in seen])).all(1)
    draws = draws[possible] if possible.any() else np.abs(draws)
    size = float(np.quantile(np.linalg.norm(draws, axis=1), LEVEL))
    gram = sum(np.einsum("tnai,tnaj->ij", j[..., seen], j[..., seen]) for j in columns.jacobians)
    squares = np.einsum("di,ij,dj->d", draws, gram, draws)
    count = sum(f.shape[0] * f.shape[1] for f in columns.fields)
    motion = math.sqrt(float(np.quantile(squares, LEVEL)) / count)
    if size < least:
        size, motion = least, motion * least / size
    middle = math.sqrt(sum(float(np.median(strength_scales(p))) ** 2 for k in seen for p in [term.strengths[k]]))
    return UpperLimit(term.name, size, 1e3 * motion, size < middle, whole.log_evidence - here.log_evidence)


def limit_of_fit(hypothesis: Hypothesis, term: EffectTerm) -> float:
    """95 % quantile of the size of the strength of ``term`` in the posterior of a model that was fitted with it: the
    linear model of ``upper_limit`` holds near zero alone."""
    names = [p.name for p in hypothesis.linear.parameters]
    index = [names.index(p.name) for p in term.strengths]
    values = [p.fitted(hypothesis.linear.values[p.name]) for p in term.strengths]
    mean, covariance = hypothesis.marginal.mean[index] + values, hypothesis.marginal.covariance[np.ix_(index, index)]
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, DRAWS, method="eigh")
    return float(np.quantile(np.linalg.norm(draws, axis=1), LEVEL))
