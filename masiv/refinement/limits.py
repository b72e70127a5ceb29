"""Upper limits of effects that were not accepted: how strong they may be without having been seen."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.evidence import Evidence, strength_scales
from masiv.inference.linear_model import LinearModel, linear_model
from masiv.inference.marginal_likelihood import Marginal, ParameterPriors, marginal_of_sizes
from masiv.models.base import EffectTerm, ForwardModel
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation
from masiv.refinement.effect_fit import absent
from masiv.refinement.hypotheses import Hypothesis
from masiv.subsample import evenly_spread

LEVEL = 0.95
"""Probability that a strength is below its limit."""
DRAWS = 2000
FREQUENCIES, PLACES = 6, 4
"""At which a force of unknown frequency, and an effect at an unknown place, is limited beside where the ranking saw it:
each takes a rollout or two for each strength. Chosen for the time that they take."""


@dataclass(frozen=True)
class UpperLimit:
    """strength: 95 % upper limit of the size of an effect's strength, in its unit, wherever it acts and at whatever
    frequency. motion_mm: root mean square change of the observed motion that it makes at that limit. determined:
    whether the limit is below the middle of the sizes that are likely beforehand: if not, the recording says little of
    the effect. log_bayes_factor: for the effect, of the linear model. reason: why there is no limit, None if there is
    one."""

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


def sensitivities(
    forward_model: ForwardModel, at: LinearModel, name: str, places: Sequence[dict[str, float]]
) -> list[tuple[dict[str, float], LinearModel]]:
    """``sensitivity`` at each of ``places``, but for those at which a rollout diverges. Raises NonFiniteError if it is
    the first."""
    found = [sensitivity(forward_model, at, name, places[0])]
    for other in places[1:]:
        with contextlib.suppress(NonFiniteError):
            found.append(sensitivity(forward_model, at, name, other))
    return found


def places_to_limit(
    term: EffectTerm, ranked: dict[str, float], observations: Sequence[Observation]
) -> list[dict[str, float]]:
    """Values of the parameters of ``term`` beside its strengths: where the ranking saw it, then some of its guesses; of
    a frequency, even from one period in the longest of ``observations`` to two instants a period. Of an effect that
    sets in abruptly the first alone: its derivatives hold near one place."""
    first = {p.name: ranked.get(p.name, p.start) for p in term.others}
    if not term.others or term.nonsmooth:
        return [first]
    if [term.units.get(p.name) for p in term.others] == ["Hz"]:
        (p,) = term.others
        low = 1 / max(float(e.times[-1]) for e in observations)
        high = 0.5 / min(float(np.median(np.diff(e.times))) for e in observations)
        shares = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES
        return [first, *({p.name: float(f)} for f in low + shares * (high - low))]
    guesses = [{p.name: v for p, v in zip(term.others, guess, strict=True)} for guess in term.guesses]
    return [first, *evenly_spread([guess for guess in guesses if guess != first], PLACES)]


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
    found: Sequence[tuple[dict[str, float], LinearModel]], least: float = 0.0,
) -> UpperLimit:  # fmt: skip
    """The limit of ``term`` in addition to the model ``at``, with the effects ``terms`` and the evidence ``here``; not
    below ``least``. found: its ``sensitivities``: all places are equally likely beforehand; the Bayes factor is that of
    the first."""
    joined = [extended(at, term, *one) for one in found]
    whole = evidence.marginal(joined[0], [*terms, term], near=here)
    # Of the widest prior of the strength: the limit is what the data say.
    priors = evidence.priors(joined[0], [*terms, term])
    wide = replace(priors, precision=priors.precision[-1:])
    sizes = evidence.marginal_with(joined[0], wide, near=here).logs
    parts = [
        _Place.of(evidence, one, columns, wide, sizes, term) for one, (_, columns) in zip(joined, found, strict=True)
    ]
    parts = [part for part in parts if part is not None]
    if not parts:
        return UpperLimit.unknown(term.name, "it moves nothing along the axes that were measured")
    logs = np.array([part.log_evidence for part in parts])
    weights = np.repeat(np.exp(logs - logs.max()), DRAWS)
    size = _quantile(np.concatenate([part.sizes for part in parts]), weights)
    motion = _quantile(np.concatenate([part.motions for part in parts]), weights)
    if size < least:
        size, motion = least, motion * least / size
    middle = math.sqrt(sum(float(np.median(strength_scales(p))) ** 2 for p in parts[0].seen))
    return UpperLimit(term.name, size, 1e3 * motion, size < middle, whole.log_evidence - here.log_evidence)


@dataclass(frozen=True)
class _Place:
    """What the posterior of a term says if it acts at one place: log evidence; of draws (DRAWS,), the sizes of the
    strength and the motions [m] that it makes. seen: strengths that move something along the measured axes."""

    log_evidence: float
    sizes: np.ndarray
    motions: np.ndarray
    seen: list[Parameter]

    @classmethod
    def of(
        cls, evidence: Evidence, joined: LinearModel, columns: LinearModel, priors: ParameterPriors, logs: np.ndarray,
        term: EffectTerm,
    ) -> _Place | None:  # fmt: skip
        """With errors of known sizes ``logs``. None if nothing is seen."""
        seen = [k for k in range(len(term.strengths)) if any(j[..., k].any() for j in columns.jacobians)]
        if not seen:
            return None
        strengths = [term.strengths[k] for k in seen]
        names = [p.name for p in joined.parameters]
        index = [names.index(p.name) for p in strengths]
        posterior = marginal_of_sizes(evidence.blocks(joined), priors, logs)
        mean, covariance = posterior.mean[index], posterior.covariance[np.ix_(index, index)]
        draws = np.random.default_rng(0).multivariate_normal(mean, covariance, 2 * DRAWS, method="eigh")
        possible = draws[(draws >= np.array([p.lower for p in strengths])).all(1)]
        draws = np.resize(possible, (DRAWS, len(seen))) if len(possible) else np.abs(draws[:DRAWS])
        gram = sum(np.einsum("tnai,tnaj->ij", j[..., seen], j[..., seen]) for j in columns.jacobians)
        count = sum(f.shape[0] * f.shape[1] for f in columns.fields)
        motions = np.sqrt(np.einsum("di,ij,dj->d", draws, gram, draws) / count)
        return cls(posterior.log_evidence, np.linalg.norm(draws, axis=1), motions, strengths)


def _quantile(values: np.ndarray, weights: np.ndarray) -> float:
    """The ``LEVEL`` quantile of ``values`` with ``weights``."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, LEVEL * reached[-1])])


def limit_of_fit(hypothesis: Hypothesis, term: EffectTerm) -> float:
    """95 % quantile of the size of the strength of ``term`` in the posterior of a model that was fitted with it: the
    linear model of ``upper_limit`` holds near zero alone."""
    names = [p.name for p in hypothesis.linear.parameters]
    index = [names.index(p.name) for p in term.strengths]
    values = [p.fitted(hypothesis.linear.values[p.name]) for p in term.strengths]
    mean, covariance = hypothesis.marginal.mean[index] + values, hypothesis.marginal.covariance[np.ix_(index, index)]
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, DRAWS, method="eigh")
    return float(np.quantile(np.linalg.norm(draws, axis=1), LEVEL))
