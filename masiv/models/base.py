"""What the loop asks of a simulation, whatever is simulated: a body filmed, a body with markers, a group of bodies."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.models.parameters import Parameter

if TYPE_CHECKING:
    from collections.abc import Mapping

    from masiv.effects.context import EffectContext
    from masiv.inference.model_fit import ModelFit
    from masiv.models.free_body import Model
    from masiv.refine.config import RefineConfig


Self = TypeVar("Self")


@dataclass(frozen=True)
class EffectTerm:
    """An effect as it may be added to a model. name: that of the effect, followed by whom it acts on where that is not
    everything; strengths: parameters that are zero where it is absent; others: its places, frequencies…; guesses:
    values of the others to try in the score test; units by parameter; bodies: whom it acts on (none: everything);
    stands_for: parameters of a model without it that it makes superfluous; kinked: see ``Effect``."""

    name: str
    effect: str
    strengths: tuple[Parameter, ...]
    others: tuple[Parameter, ...]
    guesses: tuple[tuple[float, ...], ...]
    units: dict[str, str]
    bodies: tuple[str, ...] = ()
    replaces_parameter: tuple[str, ...] = ()
    nonsmooth: bool = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*self.strengths, *self.others)


def effect_parameters(name: str) -> tuple[Parameter, ...]:
    """The parameters of an effect, named ``effect.parameter``."""
    return tuple(
        Parameter(f"{name}.{p.name}", float(np.clip(p.start, p.lower, p.upper)), p.lower, p.upper, p.step)
        for p in effect_named(name).parameters
    )


def plain_term(name: str, setting: EffectContext) -> EffectTerm:
    """An effect of the library that acts on everything."""
    effect = effect_named(name)
    own = effect_parameters(name)
    units = {f"{name}.{p.name}": p.unit for p in effect.parameters}
    cut = effect.strengths
    guesses = tuple(tuple(g) for g in effect.guesses(setting))
    return EffectTerm(name, name, own[:cut], own[cut:], guesses, units, nonsmooth=effect.hints.nonsmooth)


class Observation(Protocol):
    """One experiment: K instants at which N points are compared, the first ``fit_count`` of them fitted, the rest held
    out. noise [m]: of the observation; sigma (K,) [m]: by how much model and observation may differ with nothing
    missing; grid_changes: what each finer grid changes (K, N, A) [m], none while that is not known.
    ``dataclasses.replace`` gives it another sigma."""

    @property
    def noise_std(self) -> float: ...

    @property
    def residual_std(self) -> np.ndarray: ...

    @property
    def grid_changes(self) -> tuple[np.ndarray, ...]: ...

    @property
    def time_count(self) -> int: ...

    def whiten(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] from the first instant on, in proportion to what it says."""
        ...

    @property
    def name(self) -> str: ...

    @property
    def fit_count(self) -> int: ...

    @property
    def holds_out(self) -> bool: ...

    @property
    def points(self) -> np.ndarray:
        """Where the points are at the start (N, 3) [m]."""
        ...

    @property
    def times(self) -> np.ndarray:
        """Of the instants (T,) [s]."""
        ...

    @property
    def points_in_world(self) -> np.ndarray:
        """``points`` in the world frame."""
        ...

    @property
    def values_in_world(self) -> np.ndarray:
        """What was measured (T, N, A) [m], in the world frame along A of its axes."""
        ...

    def field_in_world(self, field: np.ndarray) -> np.ndarray:
        """A residual (T, N, A) [m] along axes of the world frame."""
        ...


class WeightedResidual:
    """A part of ``Observation``: residuals in proportion to what they say."""

    noise_std: float
    residual_std: np.ndarray
    grid_changes: tuple[np.ndarray, ...] = ()

    def whiten(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] from the first instant on: as it is where sigma is the noise, less where the model
        itself is less certain."""
        return field * (self.noise_std / self.residual_std[: len(field), None, None])


class WholeRunSplit(WeightedResidual):
    """A part of ``Observation``: a run of which all or no instants are fitted."""

    times: np.ndarray
    observed: np.ndarray
    fitted: bool

    @property
    def points(self) -> np.ndarray:
        raise NotImplementedError

    @property
    def points_in_world(self) -> np.ndarray:
        return self.points

    @property
    def values_in_world(self) -> np.ndarray:
        return self.observed.reshape(len(self.observed), -1, self.observed.shape[-1])

    def field_in_world(self, field: np.ndarray) -> np.ndarray:
        return field

    @property
    def time_count(self) -> int:
        return len(self.times)

    @property
    def fit_count(self) -> int:
        return len(self.times) if self.fitted else 0

    @property
    def holds_out(self) -> bool:
        return not self.fitted


class SharedRollouts:
    """A part of ``ForwardModel``: copies with other observations, which count their rollouts together."""

    observations: Sequence[Any]

    def __init__(self) -> None:
        self._rollouts = [0]

    @property
    def rollouts(self) -> int:
        """Rollouts so far, of this simulation and its copies."""
        return self._rollouts[0]

    @rollouts.setter
    def rollouts(self, count: int) -> None:
        self._rollouts[0] = count

    def with_observations(self: Self, observations: Sequence[Any]) -> Self:
        """See ``ForwardModel``."""
        out = copy.copy(self)
        out.observations = tuple(observations)
        return out


class ForwardModel(Protocol):
    """Residuals of models over experiments, and the parameters of a model."""

    rollouts: int

    @property
    def observations(self) -> Sequence[Any]:
        """Of ``Observation``."""
        ...

    def with_observations(self: Self, observations: Sequence[Any]) -> Self:
        """A copy that compares with ``observations`` (the same, with another noise model or grid changes). It shares
        caches, held substeps and the count of rollouts with this one, which keeps its own observations."""
        ...

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Everything that is fitted: law, effects, and the start of each experiment."""
        ...

    def candidates(self, model: Model) -> Sequence[str]:
        """Names of the terms that ``model`` lacks and that could act here."""
        ...

    def term(self, name: str) -> EffectTerm: ...

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Simulated less observed (K, N, A) [m] of each experiment in the A axes that were measured: its fitted
        instants, and the rest on request. Raises NonFiniteError."""
        ...

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """The fitted instants of all experiments, weighted, flat."""
        ...

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """What each of two or more finer grids changes, as a field over all instants of experiment ``index``; none:
        there is no finer, or it tells nothing. All experiments have as many."""
        ...

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` with the start of each experiment as its first moments alone have it, where those are known."""
        ...

    def curriculum(self, base: ModelFit) -> Sequence[ForwardModel]:
        """Shorter simulations through which refits go first, where ``base`` is so far off in the whole one that its
        derivatives point nowhere; none otherwise."""
        ...

    def is_out_of_phase(self, base: ModelFit) -> bool:
        """Whether ``base`` is so far off in this simulation that derivatives at it point nowhere."""
        ...

    def objections(self, before: ModelFit, after: ModelFit, term: EffectTerm, config: RefineConfig) -> list[str]:
        """Reasons of its own against adding ``term``."""
        ...
