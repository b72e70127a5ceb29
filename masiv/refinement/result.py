"""The result of refine: what was looked for, what was accepted and what stays unexplained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import NoiseModel
from masiv.models.base import EffectTerm, ForwardModel
from masiv.observations.base import Observation
from masiv.refinement.config import RefineConfig
from masiv.refinement.rounds import SearchResult

ADDED, NOTHING, UNEXPLAINED, RANKED = "effect added", "nothing missing", "unexplained residual", "ranked only"
CANNOT_TELL = "cannot tell"


@dataclass(frozen=True)
class Proposal:
    """The initial state to film next. velocity (3,) [m/s] and omega (3,) [rad/s], world, for which the models of the
    two effects ``distinguishes`` differ most: by ``difference_mm``, root mean square over points and instants; by
    ``present_mm`` in the motion that was filmed. not_simulated: velocity, omega and reason of initial states whose
    rollouts diverge."""

    distinguishes: tuple[str, str]
    velocity: np.ndarray
    omega: np.ndarray
    difference_mm: float
    present_mm: float | None
    not_simulated: tuple[tuple[np.ndarray, np.ndarray, str], ...] = ()


@dataclass(frozen=True)
class BodyResult:
    """Of one of several bodies: its effects, errors [mm] of its held-out observations, and the objections to an effect
    that was accepted for all bodies with one strength each."""

    effects: tuple[str, ...]
    before_mm: float
    after_mm: float
    objections: tuple[str, ...] = ()


@dataclass(frozen=True)
class SharedFit:
    """An effect that several bodies have, fitted with one strength for them all. log_bayes_factor: for
    one strength against one strength each (negative: the data asks for one each). strength_std: standard
    deviation between the bodies with one strength each, in the strength's unit."""

    term: EffectTerm
    fitted: ModelFit
    log_bayes_factor: float
    strength_std: float


@dataclass(frozen=True)
class RefineResult:
    """search: fits and rounds. ranked_only: effects were ranked and none was fitted. condition: of the observations, of
    tracks of one body. places: by effect, its place in the body's own axes [m]. bodies, shared: of several bodies."""

    search: SearchResult
    config: RefineConfig
    ranked_only: bool = False
    proposal: Proposal | None = None
    condition: str | None = None
    places: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    bodies: Mapping[str, BodyResult] = field(default_factory=dict)
    shared: tuple[SharedFit, ...] = ()

    @property
    def forward_model(self) -> ForwardModel:
        """With the observations, as whitened at the end, that all fits are compared with."""
        return self.search.forward_model

    @property
    def observations(self) -> Sequence[Observation]:
        return self.forward_model.observations

    @property
    def before(self) -> ModelFit:
        return self.search.before

    @property
    def after(self) -> ModelFit:
        return self.search.after

    @property
    def accepted(self) -> tuple[EffectTerm, ...]:
        """The terms that were added."""
        known = self.before.model.effects
        return tuple(self.forward_model.term(n) for n in self.after.model.effects if n not in known)

    def reduced_chi(self, fitted: ModelFit) -> float:
        """See ``NoiseModel.reduced_chi``. ``before`` is judged by the ``residual_std`` of its own motion: with an
        effect a body touches other things, and what a finer grid changes is another."""
        whitened = self.search.whitened_before if fitted is self.before else None
        return NoiseModel((whitened or self.forward_model).observations).reduced_chi(fitted.squares)

    @property
    def verdict(self) -> str:
        """ "unexplained residual" if so large a residual is improbable with nothing missing, whether an effect was
        added or not; else "effect added"; "nothing missing" if no effect and nothing unknown is more probable than not,
        and most effects and all of the credible set would have been seen; else "cannot tell"; "ranked only" if none was
        fitted."""
        if self.ranked_only:
            return RANKED
        if self.predictive_p["after"] < self.config.min_predictive_p:
            return UNEXPLAINED
        if self.accepted:
            return ADDED
        limits = self.search.limits
        unseen = {limit.effect for limit in limits if not limit.determined}
        seen = 2 * len(unseen) <= len(limits) and not unseen & self._plausible
        nothing = self.search.null_probability > 0.5 and self.search.unknown_probability < 0.5
        return NOTHING if seen and nothing else CANNOT_TELL

    @property
    def _plausible(self) -> frozenset[str]:
        """Terms in the credible set of the last round."""
        posterior = self.search.rounds[-1].posterior if self.search.rounds else None
        return frozenset().union(*(posterior.credible_set() if posterior else ()))

    @property
    def predictive_p(self) -> Mapping[str, float]:
        """See ``Check``; ``before`` and ``after``."""
        return {name: check.p for name, check in self.search.checks.items()} or {"before": 1.0, "after": 1.0}

    @property
    def force_in_twin(self) -> bool:
        """Whether there is a force for the discrepancy that does not make the motion for validation worse."""
        force = self.search.discrepancy
        if force is None:
            return False
        found, before = force.validation_mm, self.after.validation_mm
        return found is None or before is None or found <= before

    @property
    def changes_twin(self) -> bool:
        """Whether a twin gets anything: an effect, or a force for the discrepancy."""
        return not self.ranked_only and (bool(self.accepted) or self.force_in_twin)

    @property
    def twin_fit(self) -> ModelFit:
        """The fit that a twin is made of: with the force for the discrepancy if there is one that holds."""
        force = self.search.discrepancy
        return force if force is not None and self.force_in_twin else self.after
