"""A model of one or several throws of a body, with few parameters: a classical law, effects, and each throw's start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import causes, effect_named
from masiv.effects.effect import ContactEffect
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.models.base import EffectTerm, SharedRollouts, WeightedResidual, effect_parameters, plain_term
from masiv.models.families import Family, law_of
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.models.parameters import Parameter
from masiv.models.problem import Problem

if TYPE_CHECKING:
    from masiv.inference.model_fit import ModelFit


GRID_CHANGE = "grid_change"
"""Parameter ``grid_change@observation``: how much there is of what finer grids change."""
LOST, SHOWS = 0.25, 0.05
"""Distance, over the size of the body, from which derivatives at the end say nothing, and from which it is plain."""


@dataclass(frozen=True)
class VideoObservation(WeightedResidual):
    """One throw: rollouts of the body against its observed motion, of which frames 1…fitted-1 may be fitted.

    motion: of ``problem``'s start, simulation frame, as ``flight``, its last frame of free flight, and those before
    have it. finer: the same on finer grids with all particles, of which those
    of ``problem`` are some. noise: of the observation [m]. sigma (K,): by how much model and observation may differ at
    each instant [m] with nothing missing; the noise while the rest is not known. grid_changes: what each finer grid
    changes (K, N, 3) [m]; none while that is not known.
    """

    name: str
    problem: Problem
    fitted: int
    motion: InitialState
    flight: int
    finer: tuple[Problem, ...]
    noise_std: float
    residual_std: np.ndarray
    grid_changes: tuple[np.ndarray, ...] = ()

    @property
    def fit_count(self) -> int:
        """Instants that may be fitted; those after are held out."""
        return (self.fitted - 1) * self.problem.samples

    @property
    def holds_out(self) -> bool:
        return self.fitted - 1 < self.problem.frames

    @property
    def time_count(self) -> int:
        """All of them."""
        return self.problem.frames * self.problem.samples

    @property
    def grid_change(self) -> np.ndarray:
        """What finer grids change on average (K, N, 3) [m], of which a model may have a share."""
        return np.mean(self.grid_changes, axis=0)

    @property
    def points(self) -> np.ndarray:
        """Particles at frame 0 (N, 3) [m, simulation frame]."""
        return self.problem.start.double().numpy()

    @property
    def times(self) -> np.ndarray:
        """[s] since frame 0."""
        return np.arange(1, self.time_count + 1) / (self.problem.samples * self.problem.scene.fps)

    @property
    def points_in_world(self) -> np.ndarray:
        return self.problem.axes.points_to_world(self.points)

    @property
    def values_in_world(self) -> np.ndarray:
        return self.problem.axes.points_to_world(self.problem.targets.double().numpy())

    def field_in_world(self, field: np.ndarray) -> np.ndarray:
        return self.problem.axes.vectors_to_world(field)


@dataclass(frozen=True)
class Model:
    """A law's family (parameters to fit), how the ground holds the body, and effects by name."""

    family: Family
    contact: str
    effects: tuple[str, ...] = ()

    def with_effect(self, name: str) -> Model:
        return replace(self, effects=(*self.effects, name))


def parameters(model: Model, observations: Sequence[VideoObservation]) -> tuple[Parameter, ...]:
    """What is fitted: law and effects, shared by all experiments, and each one's throw and share of what finer grids
    change, named ``name@observation``."""
    gone = {effect_named(name).hints.replaces_parameter for name in model.effects}
    own = [
        replace(p, name=f"{p.name}@{e.name}")
        for e in observations
        for p in initial_state_parameters(e.motion, e.problem.ground_range)
        if p.name not in gone
    ]
    grids = [Parameter(f"{GRID_CHANGE}@{e.name}", 0.0, -1.0, 3.0, 0.25) for e in observations if e.grid_changes]
    # Grids first: their derivatives need no other rollout than the one before.
    return (*grids, *model.family.parameters, *own, *(p for name in model.effects for p in effect_parameters(name)))


def initial_state_of(values: Mapping[str, float], observation: VideoObservation) -> InitialState:
    """The throw of ``observation`` among ``values``."""
    suffix = f"@{observation.name}"
    return InitialState.of_values({n.removesuffix(suffix): v for n, v in values.items() if n.endswith(suffix)})


def active(model: Model, values: Mapping[str, float], problem: Problem) -> ActiveEffects | None:
    """The effects of ``model`` with their ``values``."""
    if not model.effects:
        return None
    members = tuple(
        (effect_named(n), torch.tensor([values[p.name] for p in effect_parameters(n)], dtype=torch.float32))
        for n in model.effects
    )
    return ActiveEffects(members, problem.setting())


def _path(observation: VideoObservation) -> torch.Tensor:
    """Where the particles were seen in the frames that may be fitted (T, N, 3) [m, simulation frame]."""
    path = observation.problem.setting().path
    assert path is not None
    return path[: observation.fitted]


def _run(
    problem: Problem,
    observation: VideoObservation,
    model: Model,
    values: Mapping[str, float],
    frames: int,
    steps: int | None,
) -> torch.Tensor:
    law, throw = law_of(model.family, dict(values)), initial_state_of(values, observation)
    return problem.run(law, throw, model.contact, frames, steps, active(model, values, problem))


class Simulation(SharedRollouts):
    """Residuals of models. The number of substeps is held for a family, as in ``masiv.models.families``."""

    STABLE = 1.4

    def __init__(
        self, observations: Sequence[VideoObservation], steps: dict[tuple[int, str], int] | None = None
    ) -> None:
        self.observations = tuple(observations)
        self.steps = {} if steps is None else steps
        super().__init__()
        self.last: dict[int, tuple[tuple, torch.Tensor]] = {}

    def settle(self, model: Model, values: Mapping[str, float]) -> None:
        """Hold the substeps of the model's family at what its law with ``values`` needs, if they are not held yet."""
        law = law_of(model.family, dict(values))
        for index, observation in enumerate(self.observations):
            self.steps.setdefault((index, model.family.kind), observation.problem.substeps(law))

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """See ``parameters``."""
        return parameters(model, self.observations)

    def candidates(self, model: Model) -> list[str]:
        """Effects that ``model`` lacks; one contact with the ground at most, and none where there is no ground."""
        library = causes()
        taken = model.contact == "none" or any(isinstance(effect_named(n), ContactEffect) for n in model.effects)
        apart = (*model.effects, *(n for n, e in library.items() if e.hints.needs_clamp))  # nothing holds a thrown body
        return [n for n, e in library.items() if n not in apart and not (taken and isinstance(e, ContactEffect))]

    def term(self, name: str) -> EffectTerm:
        """The effect, of all that is filmed; its guesses are of what may be fitted of the first experiment."""
        first = self.observations[0]
        term = plain_term(name, replace(first.problem.setting(), path=_path(first)))
        instead = effect_named(name).hints.replaces_parameter
        return replace(
            term, replaces_parameter=() if instead is None else tuple(f"{instead}@{e.name}" for e in self.observations)
        )

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` with each throw as it was found in free flight."""
        throws = {
            f"{p.name}@{e.name}": p.start
            for e in self.observations
            for p in initial_state_parameters(e.motion, e.problem.ground_range)
        }
        return {name: throws.get(name, value) for name, value in values.items()}

    def curriculum(self, base: ModelFit) -> list[Simulation]:
        """The frames until the residual shows, free flight at the least, then half of the rest, where a body ends
        somewhere else altogether."""
        horizons = []
        for e, squares in zip(self.observations, base.squares, strict=True):
            away = np.sqrt(squares[: e.fit_count]) / e.problem.size
            if away[-1] < LOST:
                return []
            shows = max(int(np.argmax(away > SHOWS)) // e.problem.samples, e.flight) + 2
            horizons.append((min(shows + 1, e.fitted), (shows + 1 + e.fitted) // 2))
        return [
            Simulation([replace(e, fitted=h[k]) for e, h in zip(self.observations, horizons, strict=True)], self.steps)
            for k in range(2)
        ]

    def is_out_of_phase(self, base) -> bool:
        """Never: a fall is short."""
        return False

    def objections(self, before, after, term, config) -> list[str]:
        """Where the motion was not watched for long enough to give ``term`` its name."""
        theta = torch.tensor([after.values[p.name] for p in term.parameters])
        watched = max((e.fitted - 1) / e.problem.scene.fps for e in self.observations)
        places = torch.cat([_path(e).reshape(-1, 3) for e in self.observations])
        reason = effect_named(term.effect).hints.identifiability_issue(theta, watched, places)
        return [] if reason is None else [reason]

    @torch.no_grad()
    def positions(self, model: Model, values: Mapping[str, float], index: int, frames: int) -> torch.Tensor:
        """Positions (frames * samples, N, 3) [m, simulation frame] of experiment ``index``, remembered until others are
        asked for. Raises NonFiniteError."""
        wanted = model, {n: v for n, v in values.items() if not n.startswith(GRID_CHANGE)}, frames
        if index in self.last and self.last[index][0] == wanted:
            return self.last[index][1]
        found = self._rollout(model, values, index, frames)
        self.last[index] = wanted, found
        return found

    def _rollout(self, model: Model, values: Mapping[str, float], index: int, frames: int) -> torch.Tensor:
        observation = self.observations[index]
        problem = observation.problem
        law = law_of(model.family, dict(values))
        try:
            steps = self.steps.setdefault((index, model.family.kind), problem.substeps(law))
            needed = problem.least_substeps(law)
            if needed > self.STABLE * steps:
                raise NonFiniteError(0, 0, f"the law needs {needed} substeps a frame, {steps} are taken")
            self.rollouts += 1
            return _run(problem, observation, model, values, frames, steps)
        except (InputError, NonFiniteError):
            raise
        except MasivError as failed:
            raise NonFiniteError(0, 0, str(failed)) from failed

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Simulated less observed (K, N, 3) [m] of each experiment: its fitted instants, and the rest on request."""
        out = []
        for index, observation in enumerate(self.observations):
            frames = observation.problem.frames if held_out else observation.fitted - 1
            found = self.positions(model, values, index, frames)
            field = (found - observation.problem.targets[: len(found)]).double().numpy()
            if observation.grid_changes:
                share = values.get(f"{GRID_CHANGE}@{observation.name}", 0.0)
                field += share * observation.grid_change[: len(found)]
            out.append(field)
        return out

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """The fitted instants of all experiments, weighted, flat."""
        found = zip(self.observations, self.fields(model, values), strict=True)
        return np.concatenate([e.whiten(f).ravel() for e, f in found])

    @torch.no_grad()
    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """What each finer grid with more particles changes: (K, N, 3) [m] of the particles of experiment ``index`` over
        all frames. Raises NonFiniteError."""
        observation = self.observations[index]
        problem = observation.problem
        own = self.positions(model, values, index, problem.frames)
        runs = (_run(finer, observation, model, values, problem.frames, None) for finer in observation.finer)
        return [(run[:, problem.chosen] - own).double().numpy() for run in runs]
