"""A deformable body that flies and falls, in one video or several: its model has few parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import causes, effect_named
from masiv.effects.effect import ContactEffect
from masiv.errors import MasivError
from masiv.models.base import EffectTerm, FittedModel, ForwardModel, Model, effect_parameters, plain_term
from masiv.models.cache import RolloutCache
from masiv.models.deformable import HeldSubsteps, check_substep, failures_as_divergence
from masiv.models.families import law_of
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.models.parameters import Parameter
from masiv.observations.video import VideoObservation
from masiv.scene.transforms import SimulationFrame
from masiv.workers import unwrap

GRID_CORRECTION = "grid_change"
"""Parameter ``grid_change@recording``: how much there is of the mean of its grid corrections."""
OUT_OF_REACH = 0.25
"""Error at the last fitted instant, in sizes of the body, from which derivatives of the whole recording mislead."""
VISIBLE_ERROR = 0.05
"""Error, in sizes of the body, at which a shorter part of the recording ends."""


@dataclass(frozen=True)
class FreeBodySetup:
    """A recording of the body, ready to be simulated.

    body: the particles that are compared. finer: all particles of the same motion on finer grids. start: estimate of
    the initial state; flight: the last frame of free flight, from which it is. ground_range [m]: greatest offset of the
    effective ground, 0 if there is no ground.
    """

    observation: VideoObservation
    body: FilmedBody
    finer: tuple[FilmedBody, ...]
    start: InitialState
    flight: int
    ground_range: float


class FreeBodyModel(ForwardModel):
    """Law and effects are shared by all recordings; each has its initial state and its part of the grid correction.

    The number of substeps is held for each family and recording, see ``HeldSubsteps``; effects on the stress multiply
    it if their strength asks for that, see ``halved``.
    """

    observations: Sequence[VideoObservation]
    _held_values: Mapping[str, float] | None = None

    def __init__(self, setups: Sequence[FreeBodySetup], held: HeldSubsteps | None = None) -> None:
        """held: substeps to go on with. Raises ValueError for equal names."""
        super().__init__([r.observation for r in setups])
        self.setups = tuple(setups)
        self.held = held or HeldSubsteps()
        self._kept = [RolloutCache(1) for _ in setups]

    def hold_substeps(self, model: Model, values: Mapping[str, float]) -> None:
        """Hold the substeps of the model's family at what its law with ``values`` needs, if they are not held yet."""
        law = law_of(model.family, values)
        for index, r in enumerate(self.setups):
            r.body.held_substeps(law, self.held, (index, model.family.kind))

    def shorten_substeps(self, model: Model, values: Mapping[str, float]) -> bool:
        """See ``ForwardModel``."""
        law, kind = law_of(model.family, values), model.family.kind
        try:
            needed = [1 / (r.body.scene.fps * r.body.substeps(law)) for r in self.setups]
        except MasivError:
            return False
        return any([self.held.shorten((index, kind), own) for index, own in enumerate(needed)])

    def held_at(self, values: Mapping[str, float]) -> FreeBodyModel:
        """See ``ForwardModel``."""
        out = copy.copy(self)
        out._held_values = dict(values)
        return out

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Grid corrections, law, initial states, effects. Grid corrections come first: their derivatives need no other
        rollout than the one before."""
        gone = {effect_named(name).hints.replaces_parameter for name in model.effects}
        own = [
            replace(p, name=f"{p.name}@{e.name}")
            for e, r in zip(self.observations, self.setups, strict=True)
            for p in initial_state_parameters(r.start, r.ground_range)
            if p.name not in gone
        ]
        grids = [
            Parameter(f"{GRID_CORRECTION}@{e.name}", 0.0, -1.0, 3.0, 0.25)
            for e in self.observations
            if e.grid_corrections
        ]
        return (*grids, *model.family.parameters, *own, *(p for n in model.effects for p in effect_parameters(n)))

    def initial_state(self, values: Mapping[str, float], index: int) -> InitialState:
        """The initial state of recording ``index`` among ``values``."""
        suffix = f"@{self.observations[index].name}"
        return InitialState.of_values({n.removesuffix(suffix): v for n, v in values.items() if n.endswith(suffix)})

    def candidates(self, model: Model) -> list[str]:
        """Effects that ``model`` lacks: at most one contact with the ground, none without a ground, and none that needs
        a clamp."""
        library = causes()
        taken = model.contact == "none" or any(isinstance(effect_named(n), ContactEffect) for n in model.effects)
        apart = (*model.effects, *(n for n, e in library.items() if e.hints.needs_clamp))
        return [n for n, e in library.items() if n not in apart and not (taken and isinstance(e, ContactEffect))]

    def effect_gravity(self, index: int) -> np.ndarray:
        """See ``ForwardModel``."""
        return self.setups[index].body.body.gravity

    def term(self, name: str) -> EffectTerm:
        """The effect on everything; its guesses are from the fitted frames of the first recording."""
        term = plain_term(name, self.setups[0].body.context(self.observations[0].fit_frames))
        instead = effect_named(name).hints.replaces_parameter
        replaced = () if instead is None else tuple(f"{instead}@{e.name}" for e in self.observations)
        return replace(term, replaces_parameter=replaced)

    def effect_axes(self, index: int) -> SimulationFrame:
        """See ``ForwardModel``."""
        return self.observations[index].simulation_axes

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` with each initial state as it was estimated from free flight."""
        starts = {
            f"{p.name}@{e.name}": p.start
            for e, r in zip(self.observations, self.setups, strict=True)
            for p in initial_state_parameters(r.start, r.ground_range)
        }
        return {name: starts.get(name, value) for name, value in values.items()}

    def curriculum(self, fields: Sequence[np.ndarray]) -> list[FreeBodyModel]:
        """First the frames until the error is visible, free flight at least; then half of the rest."""
        horizons = []
        for e, r, field in zip(self.observations, self.setups, fields, strict=True):
            error = np.sqrt((field[: e.fit_count] ** 2).sum(2).mean(1)) / r.body.size
            if error[-1] < OUT_OF_REACH:
                return []
            visible = max(int(np.argmax(error > VISIBLE_ERROR)) // r.body.samples, r.flight) + 2
            horizons.append((min(visible, e.fit_frames), (visible + e.fit_frames) // 2))
        shorter = []
        for k in range(2):
            cut = [e.with_fit_frames(h[k]) for e, h in zip(self.observations, horizons, strict=True)]
            shorter.append(FreeBodyModel(self.setups, self.held).with_observations(cut))
        return shorter

    def impossible(self, fitted: FittedModel, term: EffectTerm) -> list[str]:
        """Whether the fitted frames are too few to tell the effect from others."""
        theta = torch.tensor([fitted.values[p.name] for p in term.parameters])
        times = [e.fit_frames / r.body.scene.fps for e, r in zip(self.observations, self.setups, strict=True)]
        places = torch.cat([torch.as_tensor(e.seen_at_frames()).reshape(-1, 3) for e in self.observations])
        reason = effect_named(term.effect).hints.identifiability_issue(theta, max(times), places)
        return [] if reason is None else [reason]

    def active(self, model: Model, values: Mapping[str, float], body: FilmedBody) -> ActiveEffects | None:
        """The effects of ``model`` with their ``values`` on ``body``."""
        if not model.effects:
            return None
        members = [
            (effect_named(n), torch.tensor([values[p.name] for p in effect_parameters(n)], dtype=torch.float32))
            for n in model.effects
        ]
        return body.body.effects(members, body.context())

    @torch.no_grad()
    def positions(self, model: Model, values: Mapping[str, float], index: int, frames: int) -> torch.Tensor:
        """Positions (frames * samples, N, 3) [m, simulation axes] of recording ``index``; the last ones are kept.
        Raises NonFiniteError."""
        own = sorted((n, v) for n, v in values.items() if not n.startswith(GRID_CORRECTION))
        body, law = self.setups[index].body, law_of(model.family, values)
        effects = self.active(model, values, body)
        with failures_as_divergence():
            steps = self._substeps(model, values, index, effects)
            key = (model.family.kind, model.contact, model.effects, own, frames, steps)

            def rolled_out() -> dict[str, np.ndarray]:
                self.rollouts += 1
                start = self.initial_state(values, index)
                return {"positions": body.run(law, start, model.contact, frames, steps, effects).numpy()}

            return torch.from_numpy(self._kept[index].get(key, rolled_out)["positions"])

    def _substeps(
        self, model: Model, values: Mapping[str, float], index: int, effects: ActiveEffects | None
    ) -> int:  # fmt: skip
        """Of recording ``index``, in a frame. Raises NonFiniteError if those that are held are too few, and MasivError
        if those that the law or the effects ask for are too many."""
        body, law = self.setups[index].body, law_of(model.family, values)
        held = body.held_substeps(law, self.held, (index, model.family.kind))
        if effects is None:
            return held
        if self._held_values is None:
            return body.substeps_with(held, law, effects)
        at = {**values, **self._held_values}
        there = self.active(model, at, body)
        assert there is not None
        steps = body.substeps_with(held, law_of(model.family, at), there)
        check_substep(1 / (body.scene.fps * steps), 1 / (body.scene.fps * body.min_substeps(law, effects)))
        return steps

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """See ``ForwardModel``; (K, N, 3) [m, simulation axes]."""
        out = []
        for index, e in enumerate(self.observations):
            frames = e.frame_count if held_out else e.fit_frames
            field = e.residual(self.positions(model, values, index, frames).numpy()).astype(np.float64)
            if e.grid_corrections:
                part = values.get(f"{GRID_CORRECTION}@{e.name}", 0.0)
                field += part * e.grid_correction[: len(field)]
            out.append(field)
        return out

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """See ``ForwardModel``: each with all particles. Grids are simulated in several processes."""
        r = self.setups[index]
        own = self.positions(model, values, index, r.body.frames).double()
        tasks = [(model, values, index, grid) for grid in range(len(r.finer))]
        found = [unwrap(run) for run in self.workers.map(_finer_positions, tasks, shared=(self,))]
        return [(run - own).numpy() for run in found]


@torch.no_grad()
def _finer_positions(
    forward_model: FreeBodyModel, model: Model, values: Mapping[str, float], index: int, grid: int
) -> torch.Tensor:
    """Positions (T, N, 3) [m, simulation axes] of recording ``index`` on one of its finer grids. Raises
    NonFiniteError."""
    r = forward_model.setups[index]
    law, start = law_of(model.family, values), forward_model.initial_state(values, index)
    effects = forward_model.active(model, values, r.finer[grid])
    run = r.finer[grid].run(law, start, model.contact, r.body.frames, None, effects)
    return run[:, r.body.chosen].double()
