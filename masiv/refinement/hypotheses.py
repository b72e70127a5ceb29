"""Which effects act: the posterior over models with none, one or several, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from masiv.inference.evidence import GRAVITY_EFFECT, Evidence
from masiv.inference.linear_model import LinearModel, linear_model
from masiv.inference.marginal_likelihood import Marginal
from masiv.inference.model_fit import ModelFit
from masiv.models.base import ForwardModel
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError, Workers, unwrap

UNKNOWN = "something unknown"
"""Stands among effects for what no effect of the library is."""
CREDIBLE = 0.95
"""Probability of the smallest set of answers that is reported."""
NEGLIGIBLE = 12.0
"""Logarithm of the odds against a model beyond which it decides nothing. Chosen: with derivatives of the model without
the effect, the evidence of four effects of one elastic body was off by 0.5 to 2.3."""


Linearized = tuple[ModelFit, LinearModel]
"""A fit, linearised about its values over all instants."""


@dataclass(frozen=True)
class Hypothesis:
    """A law with effects, fitted, and linearised over all instants, about the fit or what is more probable near it
    (``linear.values``). marginal: its evidence."""

    fitted: ModelFit
    linear: LinearModel
    marginal: Marginal

    @property
    def effects(self) -> frozenset[str]:
        return frozenset(self.fitted.model.effects)

    @property
    def law(self) -> str:
        return self.fitted.model.family.kind

    @property
    def distance_from_mean(self) -> float:
        """Largest distance of a fitted value from its posterior mean, in standard deviations of the posterior."""
        own = [k for k, p in enumerate(self.linear.parameters) if p.name in self.fitted.values]
        spread = np.sqrt(np.diag(self.marginal.covariance)[own])
        return float((np.abs(self._mean_from_fit[own]) / spread).max(initial=0.0))

    def mean_values(self, values: Mapping[str, float], part: float = 1.0) -> dict[str, float]:
        """``values``, at which the model was linearised, moved by a ``part`` of the way to the mean of the posterior,
        within the bounds of its parameters."""
        changes = zip(self.linear.parameters, part * self.marginal.mean, strict=False)
        moved = {p.name: p.value(p.fitted(values[p.name]) + float(d)) for p, d in changes if p.name in values}
        return {**values, **moved}

    @property
    def _mean_from_fit(self) -> np.ndarray:
        """Mean of the posterior less the fitted values (P,)."""
        values, at = self.fitted.values, self.linear.values
        moved = [p.fitted(at[p.name]) - p.fitted(values[p.name]) if p.name in values else 0.0
                 for p in self.linear.parameters]  # fmt: skip
        out = self.marginal.mean.copy()
        out[: len(moved)] += moved
        return out

    @property
    def second_moment(self) -> np.ndarray:
        """Of the posterior about the fitted values, (P, P): errors of law, initial state and noise, and of a fit that
        is not at the mean of the posterior."""
        mean = self._mean_from_fit
        return self.marginal.covariance + np.outer(mean, mean)

    def with_posterior(self) -> ModelFit:
        """The fit with the root mean square distances of the posterior from its values as standard errors."""
        names = [p.name for p in self.linear.parameters]
        spread = np.sqrt(np.diag(self.second_moment))[: len(names)]
        errors = {
            p.name: float(s) * (abs(self.fitted.values[p.name]) if p.log else 1.0)
            for p, s in zip(self.linear.parameters, spread, strict=True)
            if p.name in self.fitted.values
        }
        return replace(self.fitted, stderr={**self.fitted.stderr, **errors})


def linearized(forward_model: ForwardModel, fitted: ModelFit) -> LinearModel:
    """``fitted`` with derivatives by all parameters of its model, places that were held at a guess included; and by
    gravity, which is known to a part, if the model can have another one. Raises NonFiniteError."""
    model = fitted.model
    parameters = [p for p in forward_model.parameters(model) if p.name in fitted.values]
    if GRAVITY_EFFECT not in forward_model.candidates(model):
        return linear_model(forward_model, model, fitted.values, parameters)
    term = forward_model.term(GRAVITY_EFFECT)
    values = {**fitted.values, **{p.name: 0.0 for p in term.strengths}}
    line = linear_model(forward_model, model.with_effect(term.name), values, [*parameters, *term.strengths])
    return replace(line, model=model, values=dict(fitted.values))


class Linearizations:
    """``linearized`` of several fits at once, in ``workers``; each is worked out once."""

    def __init__(self, workers: Workers | None = None) -> None:
        self.workers = workers or Workers()
        # What a key has the id of is kept, so that the id stays its own.
        self._known: dict[tuple, tuple[LinearModel, ForwardModel, tuple]] = {}

    def of(self, forward_model: ForwardModel, fitted: ModelFit) -> LinearModel:
        """Raises NonFiniteError."""
        key = _identity(forward_model, fitted)
        if key not in self._known:
            self._known[key] = linearized(forward_model, fitted), forward_model, ()
        return self._known[key][0]

    def each(self, forward_model: ForwardModel, fits: Sequence[ModelFit]) -> Iterator[LinearModel | TaskError]:
        """Of ``fits``, in order."""
        tasks = [(_identity(forward_model, f), (f,)) for f in fits]
        return self._worked_out(forward_model, linearized, tasks)

    def nearly(
        self, forward_model: ForwardModel, pairs: Sequence[tuple[ModelFit, LinearModel]]
    ) -> Iterator[LinearModel | TaskError]:
        """``nearly_linearized`` of pairs of a fit and its base, in order."""
        tasks = [((*_identity(forward_model, fit), id(base)), (fit, base)) for fit, base in pairs]
        return self._worked_out(forward_model, nearly_linearized, tasks)

    def _worked_out(
        self, forward_model: ForwardModel, function: Callable[..., LinearModel], tasks: Sequence[tuple[tuple, tuple]]
    ) -> Iterator[LinearModel | TaskError]:
        """``function`` of the arguments of each of ``tasks``, which have a key."""
        missing = {key: arguments for key, arguments in tasks if key not in self._known}
        found = iter(map_tasks(self.workers, forward_model, function, list(missing.values())))
        failed: dict[tuple, TaskError] = {}
        for key, arguments in tasks:
            if key not in self._known and key not in failed:
                line = next(found)
                if isinstance(line, TaskError):
                    failed[key] = line
                else:
                    self._known[key] = line, forward_model, arguments
            yield failed[key] if key in failed else self._known[key][0]


def _identity(forward_model: ForwardModel, fitted: ModelFit) -> tuple:
    model = fitted.model
    return id(forward_model), model.family.kind, model.contact, model.effects, tuple(sorted(fitted.values.items()))


def nearly_linearized(forward_model: ForwardModel, fitted: ModelFit, base: LinearModel) -> LinearModel:
    """``fitted`` with its own derivatives by what ``base`` lacks, a model with fewer effects and its law, and those of
    ``base`` by all else: a few rollouts in place of one a parameter. Raises NonFiniteError."""
    model = fitted.model
    wanted = [p for p in forward_model.parameters(model) if p.name in fitted.values]
    known = {p.name: j for p, j in zip(base.parameters, np.moveaxis(_joined(base), -1, 0), strict=True)}
    own = linear_model(forward_model, model, fitted.values, [p for p in wanted if p.name not in known])
    known |= {p.name: j for p, j in zip(own.parameters, np.moveaxis(_joined(own), -1, 0), strict=True)}
    gravity = [p for p in base.parameters if p.name.split(".")[0] == GRAVITY_EFFECT]
    every = (*wanted, *(p for p in gravity if GRAVITY_EFFECT in forward_model.candidates(model)))
    joined = np.stack([known[p.name] for p in every], axis=-1)
    parts = np.split(joined, np.cumsum([f.size for f in own.fields])[:-1])
    jacobians = [part.reshape(*f.shape, len(every)) for part, f in zip(parts, own.fields, strict=True)]
    return replace(own, parameters=every, jacobians=jacobians)


def _joined(linear: LinearModel) -> np.ndarray:
    """Derivatives (M, P) of all observations."""
    count = len(linear.parameters)
    return np.concatenate([j.reshape(math.prod(j.shape[:-1]), count) for j in linear.jacobians])


def weighed(
    forward_model: ForwardModel, fits: Sequence[Linearized], workers: Workers | None = None,
    evidence: Evidence | None = None,
) -> list[Hypothesis]:  # fmt: skip
    """Hypotheses of ``fits``, with one expectation of errors: that of ``evidence``, or what the best of them leaves."""
    evidence = evidence or evidence_of(forward_model, fits)
    tasks = [(line, [forward_model.term(n) for n in fit.model.effects]) for fit, line in fits]
    found = map(unwrap, (workers or Workers()).map(Evidence.marginal, tasks, shared=(evidence,)))
    return [Hypothesis(fit, line, marginal) for (fit, line), marginal in zip(fits, found, strict=True)]


def evidence_of(forward_model: ForwardModel, fits: Sequence[Linearized]) -> Evidence:
    """With the errors that the best of ``fits`` leaves."""
    _, line = min(fits, key=lambda pair: pair[0].cost)
    return Evidence.of(forward_model.observations, line.fields)


@dataclass(frozen=True)
class Posterior:
    """Probabilities of ``hypotheses``. Sets of as many effects are equally likely beforehand, and one effect more is
    half as likely in all (Scott & Berger 2010); so are laws.

    candidates: causes that could act, of which the sets are drawn. shapes: how many shapes the cause of an effect has,
    all equally likely; one if not given.
    """

    hypotheses: tuple[Hypothesis, ...]
    probabilities: tuple[float, ...]

    @classmethod
    def of(
        cls, hypotheses: Sequence[Hypothesis], candidates: int, shapes: Mapping[str, int] = MappingProxyType({})
    ) -> Posterior:
        best: dict[tuple[frozenset[str], str], Hypothesis] = {}
        for h in hypotheses:
            key = (h.effects, h.law)
            if key not in best or h.marginal.log_evidence > best[key].marginal.log_evidence:
                best[key] = h
        kept = tuple(best.values())
        of_shapes = [sum(math.log(shapes.get(name, 1)) for name in h.effects) for h in kept]
        of_sets = [log_prior(len(h.effects), candidates) for h in kept]
        logs = np.array([h.marginal.log_evidence for h in kept]) + of_sets - of_shapes
        shares = np.exp(logs - logs.max())
        return cls(kept, tuple(float(p) for p in shares / shares.sum()))

    def with_at_most(self, count: int) -> float:
        """Probability that no more than ``count`` effects act."""
        return sum(p for h, p in zip(self.hypotheses, self.probabilities, strict=True) if len(h.effects) <= count)

    def unknown(self) -> float:
        """Probability that something unknown acts, with or without effects."""
        return sum(p * h.marginal.unknown for h, p in zip(self.hypotheses, self.probabilities, strict=True))

    def sets(self) -> dict[frozenset[str], float]:
        """Probability of each set of effects, over the laws and whether something unknown acts; most probable first."""
        out: dict[frozenset[str], float] = {}
        for h, p in zip(self.hypotheses, self.probabilities, strict=True):
            out[h.effects] = out.get(h.effects, 0.0) + p
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def probability(self, fitted: ModelFit) -> float:
        """Of the effects of ``fitted``, over the laws."""
        return self.sets().get(frozenset(fitted.model.effects), 0.0)

    def best(self, count: int) -> Hypothesis | None:
        """The most probable set of ``count`` effects, with its most probable law."""
        chosen = next((s for s in self.sets() if len(s) == count), None)
        if chosen is None:
            return None
        own = [h for h in self.hypotheses if h.effects == chosen]
        return max(own, key=lambda h: h.marginal.log_evidence)

    def credible_set(self) -> dict[frozenset[str], float]:
        """The fewest sets of effects that have a probability of ``CREDIBLE`` together, over whether something unknown
        acts as well."""
        return _most_probable(self.sets())

    def credible_answers(self) -> dict[frozenset[str], float]:
        """The same with ``UNKNOWN`` among the effects."""
        parts: dict[frozenset[str], float] = {}
        for h, p in zip(self.hypotheses, self.probabilities, strict=True):
            for effects, share in ((h.effects, 1 - h.marginal.unknown), (h.effects | {UNKNOWN}, h.marginal.unknown)):
                parts[effects] = parts.get(effects, 0.0) + p * share
        return _most_probable(parts)


def _most_probable(sets: Mapping[frozenset[str], float]) -> dict[frozenset[str], float]:
    out: dict[frozenset[str], float] = {}
    for effects, p in sorted(sets.items(), key=lambda item: -item[1]):
        out[effects] = p
        if sum(out.values()) >= CREDIBLE:
            break
    return out


def log_prior(effects: int, candidates: int) -> float:
    """Logarithm of the prior of one set of ``effects``, of as many ``candidates``."""
    return -(effects + 1) * math.log(2) - math.log(math.comb(max(candidates, effects), effects))
