"""A deformable body with markers that is let go from rest, in several runs: its law, effects, and how each began.

What is fitted for a run is when it was let go, since a reader knows it to a few milliseconds, and how far from its rest
it was held. Those of a held-out run are found from its own motion; so are those of a run whose first moments are left
out.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import causes, effect_named
from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import ClockEffect, ContactEffect, Effect, GeometryEffect
from masiv.effects.per_body import DragBody
from masiv.errors import MasivError
from masiv.materials.classical import UNITS, ClassicalLaw
from masiv.models.base import EffectTerm, FittedModel, ForwardModel, Model
from masiv.models.cache import Arrays, RolloutCache
from masiv.models.deformable import HeldSubsteps, check_substep, failures_as_divergence, halved
from masiv.models.marked_body import MarkedBody, marked_body, mean_interval
from masiv.models.parameters import Parameter
from masiv.models.release import fit_release
from masiv.mpm.config import SimulatorConfig
from masiv.observations.base import rms_mm
from masiv.observations.tracks import TracksObservation, marker_observation
from masiv.tracks.tracks import Run, Tracks
from masiv.twin.from_tracks import drag_body

RELEASE_RANGE, RELEASE_STEP = 0.03, 1e-3
"""Of the delay of the release: range to either side and finite-difference step [s]."""
OFFSET_RANGE, OFFSET_STEP = 3e-3, 1e-4
"""Of the distance from the rest at which the body was held [m]."""
DEFLECTION_RANGE, DEFLECTION_STEP = 0.2, 0.01
"""Of the tip's deflection, in sizes of the body."""
OUTPUT_INTERVAL = 2.5e-3
"""Time [s] between two states of a rollout that are kept; motion between them is a cubic spline."""
KEPT_ROLLOUTS = 24
PHASE_LOST = 1.2
"""Residual over the swing about its mean from which the phase is lost; of two swings in step it is less than 1."""
PLACE_MARGIN = 0.15
"""How far from the body, in lengths of it, something that acts on it from outside may be."""
NOT_SIMULATED = (GeometryEffect, ClockEffect)
"""Effects that are no candidates: a body that rests in its clamp does not move with the ground, and a clock that is off
is a release at another time."""
MAX_MASS, MASS_STEP, FORCE_STEP, LENGTH_STEP = 30.0, 0.05, 0.05, 0.04
"""Bound and finite-difference step of a mass in masses of the body, step of a force in its weights and of a length in
its sizes."""


def run_of_body(
    tracks: Tracks, run: Run, config: SimulatorConfig, spacing: float, duration: float, skipped: float = 0.0
) -> tuple[TracksObservation, MarkedBody]:
    """``run`` from ``skipped`` to ``duration`` [s] after its release, and its body with particles ``spacing`` [m]
    apart. Raises InputError."""
    body = marked_body(tracks, run, config, particle_spacing=spacing)
    points = body.markers_to_world(body.particles[None])[0]
    speed = run.released(body.markers, skipped, duration)[2]
    return marker_observation(run, body.markers, points, duration, skipped), replace(body, speed=speed)


def output_times(run: TracksObservation) -> np.ndarray:
    """Times (K,) [s] since the release at which the states of a rollout of ``run`` are kept."""
    last = float(run.times[-1]) + RELEASE_RANGE
    return np.linspace(0, last, int(np.ceil(last / OUTPUT_INTERVAL)) + 1)


class ClampedBodyModel(ForwardModel):
    """Runs of one body.

    It has no finer grids: over many periods two of them are out of phase, which would hide all else
    (benchmarks/measured.md).
    """

    observations: Sequence[TracksObservation]
    _held_values: Mapping[str, float] | None = None

    def __init__(
        self,
        tracks: Tracks,
        runs: Sequence[tuple[TracksObservation, MarkedBody]],
        *,
        known: Mapping[str, float] | None = None,
        horizons: Sequence[float] = (),
        folder: Path | None = None,
    ) -> None:
        """runs: see ``run_of_body``. known: values of law and effects that are not fitted. horizons [s]: how much of
        what is compared a curriculum begins with. folder: where rollouts are kept."""
        super().__init__([observation for observation, _ in runs])
        self.tracks = tracks
        self.bodies = {observation.name: body for observation, body in runs}
        self.known = dict(known or {})
        self.horizons = tuple(horizons)
        self.folder = folder
        self.drag_body: DragBody = drag_body(tracks, next(iter(tracks.bodies.values())))
        self.offset_axes = np.concatenate([np.linalg.svd(tracks.up[None])[2][1:], tracks.up[None]])
        """Two horizontal axes and the vertical one (3, 3), world."""
        self.held = HeldSubsteps()
        self._rollout_cache = RolloutCache(KEPT_ROLLOUTS, folder)

    @property
    def contact(self) -> str:
        """With the ground."""
        return "sticky" if self.tracks.ground is not None else "none"

    @property
    def config(self) -> SimulatorConfig:
        """Of the simulator."""
        return self.body(self.observations[0]).config

    def over(self, observations: Sequence[TracksObservation]) -> ClampedBodyModel:
        """A model of other parts of the same runs, which holds a substep of its own."""
        runs = [(o, self.bodies[o.name]) for o in observations]
        return ClampedBodyModel(self.tracks, runs, known=self.known, folder=self.folder)

    def body(self, run: TracksObservation) -> MarkedBody:
        """The body of ``run`` at its place there."""
        return self.bodies[run.name]

    # -- models -------------------------------------------------------------------------------------------------

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Law, release of each fitted run, effects; without what is known.

        The release of a run whose first moments are left out is not among them: it is found from the run for each
        model, as that of a held-out run is (variable projection, Golub & Pereyra 1973), since an initial state, a phase
        and a mass that are fitted together are strongly correlated."""
        every = [
            *model.family.parameters,
            *(p for run in self.observations if run.fitted and not run.skipped for p in self.release_parameters(run)),
            *(p for name in model.effects for p in self.term(name).parameters),
        ]
        return tuple(p for p in every if p.name not in self.known)

    def release_parameters(self, run: TracksObservation) -> tuple[Parameter, ...]:
        """The delay [s] of the release, and how far [m] from its rest the body was held along two horizontal axes.

        If the first moments of ``run`` are left out, also how far above its rest it was held, and a deflection [m] of
        its tip at the start (see ``static_deflection``) for the energy that they took or gave. If the body was not held
        straight, the deflection is that in which it was held, where its markers are at their places at rest. Nothing of
        a body whose clamp is carried: it is at rest there, and its markers at their places at rest."""
        if self.body(run).carried:
            return ()
        names = ["lateral_offset_1", "lateral_offset_2"]
        deflection: tuple[Parameter, ...] = ()
        if run.skipped:
            names.append("vertical_offset")
        if run.skipped or not run.held_straight:
            if self.body(run).clamp_axes is not None:
                size = self.body(run).size
                reach, step = DEFLECTION_RANGE * size, DEFLECTION_STEP * size
                deflection = (Parameter(f"tip_deflection@{run.name}", 0.0, -reach, reach, step),)
        release = Parameter(f"release@{run.name}", 0.0, -RELEASE_RANGE, RELEASE_RANGE, RELEASE_STEP)
        offsets = (Parameter(f"{n}@{run.name}", 0.0, -OFFSET_RANGE, OFFSET_RANGE, OFFSET_STEP) for n in names)
        return (release, *offsets, *deflection)

    def candidates(self, model: Model) -> list[str]:
        """Effects that ``model`` lacks: at most one contact with the ground, none without a ground, those that need a
        clamp if there is one, none of ``NOT_SIMULATED``."""
        no_ground = self.tracks.ground is None
        taken = no_ground or any(isinstance(effect_named(n), ContactEffect) for n in model.effects)
        clamped = self.body(self.observations[0]).is_clamped
        return [
            name
            for name, effect in causes().items()
            if name not in model.effects
            and not isinstance(effect, NOT_SIMULATED)
            and not (isinstance(effect, ContactEffect) and taken)
            and not (effect.hints.needs_clamp and not clamped)
        ]

    def term(self, name: str) -> EffectTerm:
        """The effect, its steps in proportion to the body."""
        effect = effect_named(name)
        declared = (effect.per_body or effect).parameters
        own = [self._parameter(effect, p) for p in declared]
        cut = effect.strengths
        guesses = tuple(tuple(g) for g in effect.guesses(self._context(self.observations[0])))
        units = {f"{name}.{p.name}": p.unit for p in declared}
        return EffectTerm(name, name, tuple(own[:cut]), tuple(own[cut:]), guesses, units)

    def _parameter(self, effect: Effect, p: EffectParameter) -> Parameter:
        body = self.body(self.observations[0])
        particles = body.particles.numpy()
        low, high = particles.min(0), particles.max(0)
        size = float((high - low).max())
        mass = self.drag_body.mass
        lower, upper, step = p.lower, p.upper, p.step
        if p.unit == "kg":
            upper, step = min(upper, MAX_MASS * mass), MASS_STEP * mass
        elif p.unit == "N":
            step = FORCE_STEP * mass * float(np.linalg.norm(self.tracks.gravity))
        elif p.unit == "m":
            step = LENGTH_STEP * size
            if p.name in "xyz":
                # The face of the matter is half a spacing outside of the outermost particles.
                face = 0.5 * (body.volume / body.count) ** (1 / 3)
                k, reach = "xyz".index(p.name), face if effect.hints.inside else PLACE_MARGIN * size
                lower, upper = float(low[k]) - reach, float(high[k]) + reach
        return Parameter(f"{effect.name}.{p.name}", float(np.clip(p.start, lower, upper)), lower, upper, step)

    def _context(self, run: TracksObservation) -> EffectContext:
        duration = float(run.times[-1])
        return self.body(run).context(duration, duration / (len(run.times) - 1))

    def law(self, model: Model, values: Mapping[str, float]) -> ClassicalLaw:
        """The law among ``values`` and what is known."""
        both = {**self.known, **values}
        names = {p.name for p in model.family.parameters} | (self.known.keys() & UNITS.keys())
        return ClassicalLaw(model.family.kind, **{n: both[n] for n in names})

    # -- motion -------------------------------------------------------------------------------------------------

    def held_at(self, values: Mapping[str, float]) -> ClampedBodyModel:
        """See ``ForwardModel``."""
        out = copy.copy(self)
        out._held_values = dict(values)
        return out

    def substep(self, run: TracksObservation, model: Model, values: Mapping[str, float], times: np.ndarray) -> float:
        """The substep [s] to simulate ``run`` with to ``times`` (T,) [s]: that of its first law, or shorter if the
        effects ask for it (``halved``). Raises NonFiniteError for a law that is too stiff for it, MasivError if an
        interval needs too many."""
        body, last = self.body(run), float(times[-1])
        law, effects = self.law(model, values), self.acting(run, model, values, last)
        held = self.held.take((run.name, body.spacing), body.substep(law, times))
        shortest = mean_interval(times) / body.config.max_substeps_per_frame
        needed = body.substep(law, times, effects)
        if self._held_values is None:
            return halved(held, needed, shortest)
        at = {**values, **self._held_values}
        needed_there = body.substep(self.law(model, at), times, self.acting(run, model, at, last))
        taken = halved(held, needed_there, shortest)
        check_substep(taken, needed)
        return taken

    def shorten_substeps(self, model: Model, values: Mapping[str, float]) -> bool:
        """See ``ForwardModel``."""
        law, needed = self.law(model, values), {}
        try:
            for run in self.observations:
                body = self.body(run)
                needed[run.name, body.spacing] = body.substep(law, output_times(run))
        except MasivError:
            return False
        return any([self.held.shorten(key, own) for key, own in needed.items()])

    def acting(
        self, run: TracksObservation, model: Model, values: Mapping[str, float], duration: float
    ) -> ActiveEffects:
        """The effects of ``model``, and the clamp, over ``duration`` [s]."""
        both = {**self.known, **values}
        members = []
        for name in model.effects:
            effect = effect_named(name)
            given = torch.tensor([both[p.name] for p in self.term(name).parameters], dtype=torch.float32)
            members.append((effect, effect.per_body.of_body(given, self.drag_body) if effect.per_body else given))
        body = self.body(run)
        return body.effects(members, body.context(duration, float(np.median(np.diff(run.times)))))

    @torch.no_grad()
    def path(self, run: TracksObservation, model: Model, values: Mapping[str, float]) -> CubicSpline:
        """Markers (M, 3) [m, world] over time [s] since the release. Raises NonFiniteError."""
        body, law = self.body(run), self.law(model, values)
        deflection = values.get(f"tip_deflection@{run.name}", 0.0) if run.skipped or not run.held_straight else 0.0
        times = output_times(run)
        last = float(times[-1])
        with failures_as_divergence():
            substep = self.substep(run, model, values, times)
            effects = self.acting(run, model, values, last)
            acting = [(effect.name, theta) for effect, theta in effects.members]
            context = effects.context
            key = (
                body.digest, body.contact, body.attachment, law.kind, sorted(law.values.items()), acting,
                context.duration, context.frame_time, deflection, times, substep,
            )  # fmt: skip

            def rolled_out() -> Arrays:
                self.rollouts += 1
                instants, positions = body.run(law, times, effects, substep=substep, deflection=deflection)
                return {"times": instants, "markers": body.markers_to_world(positions)}

            found = self._rollout_cache.get(key, rolled_out)
        markers = found["markers"]
        if (deflection and not run.skipped) or body.carried:
            straight = body.markers_to_world(body.particles[None])[0]
            markers = markers - (markers[0] - straight)
        return CubicSpline(found["times"], markers)

    def markers(self, run: TracksObservation, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Markers (K, M, 3) [m, world] of the model at the run's times. Raises NonFiniteError."""
        names = [p.name for p in self.release_parameters(run)]
        if not names:
            return self.path(run, model, values)(run.times)
        if not run.fitted or not all(name in values for name in names):
            return self.fit_release(run, model, values)[1]
        start = np.array([values[name] for name in names])
        path = self.path(run, model, values)
        axes = self.offset_axes[: sum("_offset" in name.split("@")[0] for name in names)]
        return path(np.clip(run.times - start[0], 0.0, None)) + start[1 : 1 + len(axes)] @ axes

    def fit_release(
        self, run: TracksObservation, model: Model, values: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The values of ``release_parameters`` that bring ``run`` nearest to its own motion, and its markers (K, M, 3)
        [m]. Raises NonFiniteError."""

        def path_at(deflection: float) -> CubicSpline:
            return self.path(run, model, {**values, f"tip_deflection@{run.name}": deflection})

        return fit_release(self.release_parameters(run), run.times, run.values, self.offset_axes, path_at)

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """See ``ForwardModel``; (K, M, 3) [m, world]."""
        return [
            run.residual(self.markers(run, model, values) if run.fitted or held_out else run.values[:0])
            for run in self.observations
        ]

    def curriculum(self, fields: Sequence[np.ndarray]) -> Sequence[ClampedBodyModel]:
        """The first moments, then ever more, if the phase is lost. Empty if those are left out: an effective start
        makes up for nearly any motion that is short."""
        runs = [run for run in self.observations if run.fitted]
        if not self._phase_lost(fields) or any(run.skipped for run in runs):
            return ()
        return [self.over([run.shortened(horizon) for run in runs]) for horizon in self.horizons]

    def is_out_of_phase(self, fields: Sequence[np.ndarray]) -> bool:
        """Whether the phase is lost, and there are no first moments to count it from."""
        return self._phase_lost(fields) and any(run.skipped for run in self.observations)

    def _phase_lost(self, fields: Sequence[np.ndarray]) -> bool:
        """Whether the residual is as large as the swing."""
        swing = [run.values - run.values.mean(0) for run in self.observations if run.fitted]
        fitted = [field[: run.fit_count] for run, field in zip(self.observations, fields, strict=True)]
        return rms_mm(fitted) >= PHASE_LOST * rms_mm(swing)

    def impossible(self, fitted: FittedModel, term: EffectTerm) -> list[str]:
        """What the medium cannot do, and whether the runs are too short to tell the effect from others."""
        theta = torch.tensor([fitted.values[p.name] for p in term.parameters], dtype=torch.float64)
        per_body = effect_named(term.effect).per_body
        why = per_body.violates_bounds(theta, self.drag_body) if per_body else None
        duration = max(float(run.times[-1]) for run in self.observations if run.fitted)
        places = torch.cat([torch.as_tensor(run.points, dtype=torch.float64) for run in self.observations])
        reason = effect_named(term.effect).hints.identifiability_issue(theta, duration, places)
        return [text for text in (why, reason) if text is not None]
