"""What a search is given, and how far it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from masiv.effects.catalogue import cause_of, effect_named
from masiv.inference.discretization import with_residual_std
from masiv.inference.model_fit import ModelFit, warm_started_fit
from masiv.inference.noise_model import NoiseModel
from masiv.models.base import ForwardModel, Model
from masiv.progress import Progress, silent
from masiv.refinement.config import RefineConfig
from masiv.refinement.hypotheses import Linearizations
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError, Workers, unwrap


@dataclass(frozen=True)
class SearchSettings:
    """config: see ``RefineConfig``; max_effects, shortlist: its values unless given. rank_only: rank the effects, fit
    none. discrepancy_force: if much stays unexplained, fit a smooth force for it. all_shapes: who names a cause asks
    for all shapes of it."""

    config: RefineConfig
    max_effects: int
    shortlist: int
    rank_only: bool = False
    discrepancy_force: bool = True
    all_shapes: bool = True
    workers: Workers = field(default_factory=Workers)
    progress: Progress = silent
    linearizations: Linearizations = field(default_factory=Linearizations)

    @classmethod
    def of(
        cls, config: RefineConfig, *, rank_only: bool = False, discrepancy_force: bool = True,
        workers: Workers | None = None, progress: Progress = silent,
    ) -> SearchSettings:  # fmt: skip
        """As ``config`` has them."""
        return cls(
            config, config.max_effects, config.shortlist, rank_only, discrepancy_force, True,
            workers or Workers(), progress, Linearizations(workers),
        )  # fmt: skip

    def for_effects(self, effects: Sequence[str]) -> SearchSettings:
        """With ``effects`` alone, and no other shapes of them, whatever part of the residual they explain."""
        config = self.config.model_copy(update={"effects": sorted(set(effects)), "min_explained": 0.0})
        return replace(self, config=config, all_shapes=False)

    def considered(self, forward_model: ForwardModel, model: Model) -> list[str]:
        """Terms that may be added to ``model``, of the effects that the configuration names, in its order, and of their
        other shapes; if it names none, of all but those on request."""
        present = {forward_model.term(n).effect for n in model.effects}
        return [
            n
            for n in self._wanted(forward_model, model)
            if not any(e != (own := forward_model.term(n).effect) and cause_of(e) == cause_of(own) for e in present)
        ]

    def causes(self, forward_model: ForwardModel, model: Model) -> list[list[str]]:
        """The causes that may act, those in ``model`` included: of each, its shapes by the names of their terms."""
        found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
        for name in (*self._wanted(forward_model, model), *model.effects):
            term = forward_model.term(name)
            found.setdefault((cause_of(term.effect), term.bodies), []).append(name)
        return list(found.values())

    def _wanted(self, forward_model: ForwardModel, model: Model) -> list[str]:
        names = forward_model.candidates(model)
        wanted = self.config.effects
        if not wanted:
            return [n for n in names if not effect_named(forward_model.term(n).effect).hints.on_request]
        own = []
        for name in names:
            effect = forward_model.term(name).effect
            asked = [n for n in (effect, *([cause_of(effect)] if self.all_shapes else [])) if n in wanted]
            if asked:
                own.append((wanted.index(asked[0]), name))
        return [name for _, name in sorted(own, key=lambda pair: pair[0])]


@dataclass(frozen=True)
class SearchState:
    """A fit, and the forward model with whose observations it is compared. observation_std: of each observation (T,)
    [m], the part of ``residual_std`` that is measurement. robust_scale [m]: whitened residuals above it are
    outliers."""

    forward_model: ForwardModel
    fit: ModelFit
    observation_std: Sequence[np.ndarray]
    robust_scale: float

    @property
    def noise(self) -> NoiseModel:
        return NoiseModel(self.forward_model.observations)

    @property
    def reduced_chi(self) -> float:
        """See ``NoiseModel.reduced_chi``."""
        return self.noise.reduced_chi(self.fit.squares)

    def with_fit(self, fit: ModelFit) -> SearchState:
        return replace(self, fit=fit)

    def whitened_again(self, rivals: Sequence[ModelFit], workers: Workers) -> tuple[SearchState, list[ModelFit]]:
        """With ``residual_std`` as ``fit`` moves, and ``fit`` refitted if that changes it: with an effect the body may
        touch what it did not, earlier than before, and what a finer grid changes is another. And ``rivals`` refitted,
        but for those that cannot be simulated. Raises MasivError."""
        updated = with_residual_std(self.forward_model, self.fit, self.observation_std)
        own = [] if same_residual_std(updated, self.forward_model) else [self.fit]
        tasks = [(fit, self.robust_scale) for fit in (*own, *rivals)]
        refitted = list(map_tasks(workers, updated, warm_started_fit, tasks))
        fit = unwrap(refitted[0]) if own else self.fit
        others = [other for other in refitted[len(own) :] if not isinstance(other, TaskError)]
        return replace(self, forward_model=updated, fit=fit), others


def same_residual_std(one: ForwardModel, other: ForwardModel) -> bool:
    """Whether two forward models whiten alike."""
    pairs = zip(one.observations, other.observations, strict=True)
    return all(np.array_equal(a.residual_std, b.residual_std) for a, b in pairs)
