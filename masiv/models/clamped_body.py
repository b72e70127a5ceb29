"""Runs of one deformable body with markers, let go from rest: the simulations that refine's loop works on.

They fulfil ``masiv.models.base.Simulated``. What is fitted beside the law and the effects is when each run was let
go, since a reader knows it to a few milliseconds, and how far aside (horizontally) it was held; those of a held-out run
are found from its own motion, and so are those of a run whose first moments are left out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import causes, effect_named
from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import ClockEffect, ContactEffect, Effect, GeometryEffect
from masiv.effects.per_body import DragBody
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.files import write_npz
from masiv.inference.model_fit import ModelFit, rms_mm
from masiv.materials.classical import ClassicalLaw
from masiv.models.base import EffectTerm, SharedRollouts, WholeRunSplit
from masiv.models.free_body import Model
from masiv.models.marker_body import Plan, SimulatedBody, plan, simulated_body
from masiv.models.parameters import Parameter
from masiv.models.release import clamp_axes, fit_release
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.rollout import rollout
from masiv.refine.config import RefineConfig
from masiv.tracks.tracks import Run, Tracks
from masiv.twin.from_tracks import drag_body

RELEASE_REACH, RELEASE_STEP = 0.03, 1e-3
OFFSET_REACH, OFFSET_STEP = 3e-3, 1e-4
FINEST_OUTPUT = 2.5e-3
"""Time [s] between two states of a rollout that are kept; motion between them is a cubic spline."""
STABLE = 1.3
"""A law may become this much stiffer than the one that the substep is for: the Courant number leaves as much."""
DEFLECTION_REACH, DEFLECTION_STEP = 0.2, 0.01
"""In sizes of the body."""
KEPT = 24
LOST = 1.2
"""Residual over the swing about its mean from which the phase is lost; of two swings in step it is less than 1."""
BESIDE = 0.15
"""How far from the body, in lengths of it, something that acts on it may be."""


@dataclass(frozen=True)
class BodyRun(WholeRunSplit):
    """A run from its release on: observed (K, M, 3) [m, world] of the markers tied to the body at ``times`` (K,) [s
    since the release that the reader found], frames where one is not seen left out. speed [m/s]: their greatest;
    noise [m], sigma (K,): see ``masiv.models.base.Observation``, the noise while the body is held; skip [s]: the
    time after the release that is left out."""

    name: str
    condition: str
    times: np.ndarray
    observed: np.ndarray
    body: SimulatedBody
    fitted: bool
    speed: float
    noise_std: float
    residual_std: np.ndarray
    skip: float = 0.0

    @property
    def points(self) -> np.ndarray:
        return self.body.markers_to_world(self.body.particles[None])[0]

    @property
    def starts(self) -> tuple[Parameter, ...]:
        """How much later [s] it was let go, and how far [m] from its rest it was held along two horizontal axes.

        Where its first moments are left out, also how far above its rest it was held, and an effective tip deflection
        [m] at the start (see ``static_deflection``), for the energy that they took or gave."""
        lateral = ("lateral_offset_1", "lateral_offset_2")
        axes = lateral if not self.skip else (*lateral, "vertical_offset")
        offsets = (Parameter(f"{axis}@{self.name}", 0.0, -OFFSET_REACH, OFFSET_REACH, OFFSET_STEP) for axis in axes)
        bends = self.skip and clamp_axes(self.body.gravity, self.body.normals) is not None
        deflection = (self._tip_deflection(),) if bends else ()
        return (
            Parameter(f"release@{self.name}", 0.0, -RELEASE_REACH, RELEASE_REACH, RELEASE_STEP),
            *offsets,
            *deflection,
        )

    def _tip_deflection(self) -> Parameter:
        size = self.body.size
        return Parameter(
            f"tip_deflection@{self.name}",
            0.0,
            -DEFLECTION_REACH * size,
            DEFLECTION_REACH * size,
            DEFLECTION_STEP * size,
        )


def body_run(
    tracks: Tracks, run: Run, config: SimulatorConfig, spacing: float, duration: float, skip: float = 0.0
) -> BodyRun:
    """``run`` from ``skip`` to ``duration`` [s] after its release, with particles ``spacing`` [m] apart. Raises
    InputError."""
    body = simulated_body(tracks, run, config, particle_spacing=spacing)
    markers = list(body.markers)
    times, observed, speed = run.released(body.markers, skip, duration)
    noise = 1e-6 if run.noise_std is None else max(float(np.sqrt((run.noise_std[markers] ** 2).sum(1).mean())), 1e-6)
    residual_std = np.full(len(times), noise)
    return BodyRun(run.name, run.condition, times, observed, body, run.purpose == "fit", speed, noise, residual_std,
                   skip)  # fmt: skip


class BodySimulation(SharedRollouts):
    """Runs of one body. known: values of law and effects that are not fitted; contact: with the ground."""

    def __init__(
        self,
        tracks: Tracks,
        runs: Sequence[BodyRun],
        config: SimulatorConfig,
        *,
        known: Mapping[str, float] | None = None,
        horizons: Sequence[float] = (),
        folder: Path | None = None,
    ) -> None:
        """runs: see ``body_run``; horizons [s]: how much of what is compared a search may look at first; folder: where
        rollouts are kept, which are many and long."""
        self.horizons = tuple(horizons)
        self.folder = folder
        self.tracks = tracks
        self.observations: Sequence[BodyRun] = tuple(runs)
        self.config = config
        self.known = dict(known or {})
        self.outline: DragBody = drag_body(tracks, next(iter(tracks.bodies.values())))
        self.ground = tracks.ground is not None
        self.across = np.concatenate([np.linalg.svd(tracks.up[None])[2][1:], tracks.up[None]])
        """Two horizontal axes and the vertical one (3, 3), world."""
        super().__init__()
        self.substeps: dict[tuple[str, float], float] = {}
        self.kept: dict[tuple, CubicSpline] = {}

    def over(self, runs: Sequence[BodyRun]) -> BodySimulation:
        """The same with other runs."""
        return BodySimulation(self.tracks, runs, self.config, known=self.known, folder=self.folder)

    # -- models -------------------------------------------------------------------------------------------------

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Law, release of each fitted run, effects; without what is known.

        The starts of a run whose first moments are left out are not among them: they are found from it for each model,
        as those of a held-out run are (variable projection, Golub & Pereyra 1973), since a launch, a phase and a mass
        that are fitted side by side lead into one another's way."""
        every = [
            *model.family.parameters,
            *(p for run in self.observations if run.fitted and not run.skip for p in run.starts),
            *(p for name in model.effects for p in self.term(name).parameters),
        ]
        return tuple(p for p in every if p.name not in self.known)

    def candidates(self, model: Model) -> list[str]:
        """Effects that ``model`` lacks; a clock that is off is a release at another time, and so is fitted already."""
        taken = not self.ground or any(isinstance(effect_named(n), ContactEffect) for n in model.effects)
        out = []
        for name, effect in causes().items():
            on_ground = isinstance(effect, (ContactEffect, GeometryEffect))
            clock = isinstance(effect, ClockEffect)
            free = effect.hints.needs_clamp and not len(self.observations[0].body.heights)
            if name not in model.effects and not clock and not (on_ground and taken) and not free:
                out.append(name)
        return out

    def term(self, name: str) -> EffectTerm:
        """The effect, its steps in proportion to the body."""
        effect = effect_named(name)
        declared = (effect.per_body or effect).parameters
        own = [self._parameter(effect, p) for p in declared]
        cut = effect.strengths
        guesses = tuple(tuple(g) for g in effect.guesses(self._setting(self.observations[0])))
        units = {f"{name}.{p.name}": p.unit for p in declared}
        return EffectTerm(name, name, tuple(own[:cut]), tuple(own[cut:]), guesses, units)

    def _parameter(self, effect: Effect, p: EffectParameter) -> Parameter:
        particles = self.observations[0].body.particles.numpy()
        low, high = particles.min(0), particles.max(0)
        size = float((high - low).max())
        lower, upper, step = p.lower, p.upper, p.step
        if p.unit == "kg":
            upper, step = min(upper, 30 * self.outline.mass), 0.05 * self.outline.mass
        elif p.unit == "N":
            step = 0.05 * self.outline.mass * float(np.linalg.norm(self.tracks.gravity))
        elif p.unit == "m":
            step = 0.04 * size
            if p.name in "xyz":  # a place is in the body or at it
                k, reach = "xyz".index(p.name), 0.0 if effect.hints.inside else BESIDE * size
                lower, upper = float(low[k]) - reach, float(high[k]) + reach
        return Parameter(f"{effect.name}.{p.name}", float(np.clip(p.start, lower, upper)), lower, upper, step)

    def _setting(self, run: BodyRun) -> EffectContext:
        duration = float(run.times[-1])
        return run.body.effects((), duration=duration, frame_time=duration / (len(run.times) - 1)).context

    def _members(self, model: Model, values: Mapping[str, float]) -> tuple:
        out = []
        for name in model.effects:
            effect = effect_named(name)
            given = torch.tensor([values[p.name] for p in self.term(name).parameters], dtype=torch.float32)
            out.append((effect, effect.per_body.of_body(given, self.outline) if effect.per_body else given))
        return tuple(out)

    def law(self, model: Model, values: Mapping[str, float]) -> ClassicalLaw:
        """The law among ``values`` and what is known."""
        both = {**self.known, **values}
        names = {p.name for p in model.family.parameters} | (self.known.keys() & LAW_NAMES)
        return ClassicalLaw(model.family.kind, **{n: both[n] for n in names})

    # -- motion -------------------------------------------------------------------------------------------------

    def planned(self, run: BodyRun, model: Model, values: Mapping[str, float], times: np.ndarray) -> Plan:
        """How to simulate ``run`` to ``times`` (T,) [s]: by the substep of its first law. NonFiniteError for one
        that is much stiffer."""
        law = self.law(model, values)
        planned = plan(run.body, law, times, self.config, speed=run.speed)
        needed = planned.simulator.substep
        held = self.substeps.setdefault((run.name, run.body.spacing), needed)
        if needed * STABLE < held:
            raise NonFiniteError(0, 0, f"the law needs substeps of {needed:.2g} s, not {held:.2g} s")
        return plan(run.body, law, times, self.config, substep=held)

    def acting(self, run: BodyRun, model: Model, values: Mapping[str, float], duration: float) -> ActiveEffects:
        """The effects of ``model``, and the clamp."""
        frame_time = float(np.median(np.diff(run.times)))
        members = self._members(model, {**self.known, **values})
        return run.body.effects(members, duration=duration, frame_time=frame_time)

    @torch.no_grad()
    def path(self, run: BodyRun, model: Model, values: Mapping[str, float]) -> CubicSpline:
        """Markers (M, 3) [m, world] over time [s] since the release. Raises NonFiniteError."""
        both = {**self.known, **values}
        deflection = values.get(f"tip_deflection@{run.name}", 0.0) if run.skip else 0.0
        key = (
            run.name,
            float(run.times[-1]),
            model.effects,
            tuple(sorted((n, v) for n, v in both.items() if "@" not in n)),
            *([deflection] if deflection else []),
        )
        if key in self.kept:
            return self.kept[key]
        file = self._file(run, model, key)
        if file is not None and file.is_file():
            with np.load(file) as saved:
                self.substeps.setdefault((run.name, run.body.spacing), float(saved["substep"]))
                self.kept[key] = CubicSpline(saved["times"], saved["markers"])
            return self.kept[key]
        last = float(run.times[-1]) + RELEASE_REACH
        times = np.linspace(0, last, int(np.ceil(last / FINEST_OUTPUT)) + 1)
        try:
            planned = self.planned(run, model, values, times)
            active = self.acting(run, model, values, last)
            self.rollouts += 1
            state = run.body.released(planned.simulator.dtype, deflection)
            law = self.law(model, values)
            positions = rollout(planned.simulator, law, state, planned.steps, planned.outputs, active)
        except (InputError, NonFiniteError):
            raise
        except MasivError as failed:
            raise NonFiniteError(0, 0, str(failed)) from failed
        at = np.array(planned.outputs) * planned.simulator.substep
        markers = run.body.markers_to_world(positions)
        if file is not None:
            write_npz(file, compressed=False, times=at, markers=markers, substep=planned.simulator.substep)
        spline = CubicSpline(at, markers)
        if len(self.kept) >= KEPT:
            self.kept.pop(next(iter(self.kept)))
        self.kept[key] = spline
        return spline

    def _file(self, run: BodyRun, model: Model, key: tuple) -> Path | None:
        """Where a rollout is kept on disk, so that a search that was killed goes on."""
        if self.folder is None:
            return None
        held = self.substeps.get((run.name, run.body.spacing))
        told = (
            key,
            model.family.kind,
            len(run.body.particles),
            run.body.spacing,
            self.config.model_dump(),
            held is None,
        )
        return self.folder / f"{hashlib.sha256(repr(told).encode()).hexdigest()[:24]}.npz"

    def markers(self, run: BodyRun, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Markers (K, M, 3) [m, world] of the model at the run's times."""
        names = [p.name for p in run.starts]
        if not run.fitted or not all(name in values for name in names):
            return self.fit_release(run, model, values)[1]
        start = np.array([values[name] for name in names])
        path = self.path(run, model, values)
        axes = self.across[: sum(not name.startswith(("release", "tip_deflection")) for name in names)]
        return path(np.clip(run.times - start[0], 0.0, None)) + start[1 : 1 + len(axes)] @ axes

    def fit_release(self, run: BodyRun, model: Model, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """The values of ``run.starts`` that bring it nearest to its own motion, and its markers (K, M, 3) [m]."""

        def path_at(deflection: float) -> CubicSpline:
            return self.path(run, model, {**values, f"tip_deflection@{run.name}": deflection})

        return fit_release(run.starts, run.times, run.observed, self.across, path_at)

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Simulated less observed (K, M, 3) [m, world] of each run; of a held-out run nothing but on request."""
        return [
            self.markers(run, model, values) - run.observed
            if run.fitted or held_out
            else np.zeros((0, *run.observed.shape[1:]))
            for run in self.observations
        ]

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Of the fitted runs, weighted, flat."""
        found = zip(self.observations, self.fields(model, values), strict=True)
        return np.concatenate([run.whiten(f).ravel() for run, f in found])

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """None: over many periods two grids are out of phase, which would hide all else. See benchmarks/measured.md."""
        return []

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """As they are: no start is known but from a fit."""
        return dict(values)

    def curriculum(self, base: ModelFit) -> Sequence[BodySimulation]:
        """The first moments, then ever more, where the phase is lost. None where they are left out: an effective start
        makes up for nearly any motion that is short."""
        runs = [run for run in self.observations if run.fitted]
        if not self._out_of_phase(base) or any(run.skip for run in runs):
            return ()
        return [self.over([shortened(run, horizon) for run in runs]) for horizon in self.horizons]

    def is_out_of_phase(self, base: ModelFit) -> bool:
        """Whether the phase is lost, and there are no first moments to count it from."""
        return self._out_of_phase(base) and any(run.skip for run in self.observations)

    def _out_of_phase(self, base: ModelFit) -> bool:
        """Whether the residual is as large as the swing."""
        swing = [run.observed - run.observed.mean(0) for run in self.observations if run.fitted]
        return base.fit_mm >= LOST * rms_mm(swing)

    def objections(self, before: ModelFit, after: ModelFit, term: EffectTerm, config: RefineConfig) -> list[str]:
        """What the medium cannot do."""
        theta = torch.tensor([after.values[p.name] for p in term.parameters], dtype=torch.float64)
        per_body = effect_named(term.effect).per_body
        why = per_body.violates_bounds(theta, self.outline) if per_body else None
        return [] if why is None else [why]


LAW_NAMES = frozenset({"youngs_modulus", "poissons_ratio", "yield_stress", "friction_angle", "viscosity",
                       "bulk_modulus", "shear_modulus", "plastic_viscosity"})  # fmt: skip


def shortened(run: BodyRun, duration: float) -> BodyRun:
    """The first ``duration`` [s] of what is compared of a run."""
    kept = run.times <= run.skip + duration
    return replace(run, times=run.times[kept], observed=run.observed[kept], residual_std=run.residual_std[kept])
