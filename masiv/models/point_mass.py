"""Light rigid bodies in flight, each a mass point: what several of them share, and what each has of its own.

The bodies fulfil the interface of refine's loop (``masiv.models.base.Simulated``). Gravity, wind and the like are
shared by all; a drag is shared by all or belongs to one kind. A run that is held out is predicted from its own place
and velocity at its first frame, which say nothing of the physics; all else comes from the runs that are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from masiv.effects.catalogue import causes, effect_named
from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import Effect, NodalEffect
from masiv.effects.per_body import DragBody
from masiv.errors import InputError, NonFiniteError
from masiv.inference.model_fit import ModelFit, rms_mm
from masiv.kernels.points import point_kernels
from masiv.models.base import EffectTerm, SharedRollouts, WholeRunSplit, plain_term
from masiv.models.families import Family
from masiv.models.free_body import Model
from masiv.models.parameters import Parameter
from masiv.refine.config import RefineConfig
from masiv.scene.transforms import SimulationFrame
from masiv.tracks.tracks import Run, Tracks
from masiv.twin.from_tracks import drag_body

RIGID = Family("rigid", (), {})
"""The law of a body that does not deform: nothing to fit."""
LONGEST_SUBSTEP = 5e-3
EACH = "each"
SMOOTH = 6
"""Degree of the polynomial that stands for any smooth flight."""
REFITS = 4
"""Gauss-Newton steps for the start of a run that is held out; without drag one is exact."""


@dataclass(frozen=True)
class PointRun(WholeRunSplit):
    """One run of a mass point. observed (K, A) [m, world] along ``axes`` at ``times`` (K,) [s] from the first on; noise
    [m] of it, see ``flight_noise``; sigma (K,): see ``masiv.models.base.Observation``."""

    name: str
    body: str
    times: np.ndarray
    observed: np.ndarray
    axes: tuple[int, ...]
    fitted: bool
    outline: DragBody
    noise_std: float
    residual_std: np.ndarray

    @property
    def points(self) -> np.ndarray:
        return np.zeros((1, 3))

    def starts(self) -> tuple[Parameter, ...]:
        """Place and velocity at the first frame, in the axes that were measured."""
        first = self.observed[0]
        slope = np.polynomial.polynomial.polyfit(self.times[:5], self.observed[:5], 1)[1]
        size = max(float(np.ptp(self.observed, axis=0).max()), 0.1)
        speed = size / self.times[-1]
        out = []
        for k, axis in enumerate(self.axes):
            a, x, v = "xyz"[axis], float(first[k]), float(slope[k])
            reach = 0.5 * size
            out.append(Parameter(f"position_{a}@{self.name}", x, x - reach, x + reach, 0.01 * size))
            out.append(Parameter(f"velocity_{a}@{self.name}", v, v - 2 * speed, v + 2 * speed, 0.05 * speed))
        return tuple(out)


def point_runs(tracks: Tracks, group: str) -> tuple[PointRun, ...]:
    """The runs of the bodies of ``group``. Raises InputError where one cannot be a mass point, or no run is fitted."""
    bodies = tracks.groups().get(group)
    if bodies is None:
        raise InputError(f"{tracks.path} has no group '{group}': it has {', '.join(tracks.groups())}")
    out = [_point_run(tracks, run) for run in tracks.runs if run.body in {b.name for b in bodies}]
    if not any(run.fitted for run in out):
        raise InputError(f"{tracks.path}: no run of group {group} may be fitted: give one `use: fit`")
    return tuple(out)


def _point_run(tracks: Tracks, run: Run) -> PointRun:
    body = tracks.bodies[run.body]
    if len(run.markers) != 1 or body.clamp is not None:
        raise InputError(
            f"{tracks.path}: run {run.name}: a body of a group flies free and has one marker, its middle: "
            "choose it with markers, and leave out the clamp"
        )
    moving = run.moving()
    axes = tuple(int(a) for a in np.flatnonzero(moving.axes[0]))
    seen = moving.seen[:, 0]
    if seen.sum() < 6:
        raise InputError(f"{tracks.path}: run {run.name} has {int(seen.sum())} frames in flight: it needs 6 or more")
    times = moving.times[seen]
    outline = drag_body(tracks, body)
    observed = moving.positions[seen][:, 0, list(axes)]
    times = times - times[0]
    noise = flight_noise(times, observed)
    residual_std = np.full(len(times), noise)
    return PointRun(run.name, body.name, times, observed, axes, run.purpose == "fit", outline, noise, residual_std)


def flight_noise(times: np.ndarray, observed: np.ndarray) -> float:
    """Root mean square distance [m] of a flight (K, A) from the nearest polynomial: what no smooth motion explains, a
    lower bound of the noise. A flight of few frames hides it: a micrometre then stands for none."""
    if len(times) <= 2 * SMOOTH:
        return 1e-6
    basis = np.polynomial.chebyshev.chebvander(2 * times / times[-1] - 1, SMOOTH)
    left = observed - basis @ np.linalg.lstsq(basis, observed, rcond=None)[0]
    return max(math.sqrt(float((left**2).sum()) / (len(times) - SMOOTH - 1)), 1e-6)


class PointSimulation(SharedRollouts):
    """Mass points of a group under gravity and effects. See ``masiv.models.base.Simulated``."""

    def __init__(
        self, tracks: Tracks, runs: Sequence[PointRun], known: Mapping[str, float] | None = None,
        substep: float = LONGEST_SUBSTEP,
    ) -> None:  # fmt: skip
        """runs: see ``point_runs``. known: parameters of effects that are not fitted."""
        self.tracks = tracks
        self.observations: Sequence[PointRun] = tuple(runs)
        self.given = dict(known or {})
        self.frame = SimulationFrame.from_scene(tracks.up, tracks.ground)
        self.gravity = self.frame.vectors_to_simulation(tracks.gravity)
        self.bodies = tuple(dict.fromkeys(run.body for run in self.observations))
        self.substep = substep
        super().__init__()
        self.terms: dict[str, EffectTerm] = {}

    # -- models -------------------------------------------------------------------------------------------------

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """The start of each fitted run, and the effects."""
        own = [p for run in self.observations if run.fitted for p in run.starts()]
        of_effects = [p for name in model.effects for p in self.term(name).parameters]
        return (*own, *(p for p in of_effects if p.name not in self.given))

    def alone(self, body: str, model: Model, values: Mapping[str, float]) -> PointSimulation:
        """The runs of one body. The effects of ``model`` act as ``values`` say."""
        known = {p.name: values[p.name] for name in model.effects for p in self.term(name).parameters}
        runs = [run for run in self.observations if run.body == body]
        made = PointSimulation(self.tracks, runs, {**self.given, **known}, self.substep)
        made.terms = dict(self.terms)
        return made

    def candidates(self, model: Model) -> list[str]:
        """Effects of the surroundings once; those that depend on the body once for all, and once a body."""
        out, taken = [], [self.term(name) for name in model.effects]
        for name, effect in causes().items():
            at_place = any(p.unit == "m" for p in effect.parameters[effect.strengths :])
            if at_place or not isinstance(effect, NodalEffect):
                continue  # what acts at a place is not told by a point that passes it once
            has = [t for t in taken if t.effect == name]
            if not has:
                out.append(self.made(name, ()).name)
            differs = effect.per_body is not None and effect.per_body.differs_by_body
            if differs and len(self.bodies) > 1 and all(t.bodies for t in has):
                held = {b for t in has for b in t.bodies}
                fitted = {run.body for run in self.observations if run.fitted}
                alone = [b for b in self.bodies if b not in held and b in fitted]
                out += [self.made(name, (b,)).name for b in alone]
                if len(alone) > 1:
                    out.append(self.made(name, tuple(alone), each=True).name)
        return out

    def made(self, effect: str, bodies: tuple[str, ...], *, each: bool = False) -> EffectTerm:
        """``effect`` on ``bodies`` alone, all with the same strength or ``each`` with its own; on all, with the same,
        where none are given."""
        known = effect_named(effect)
        scope = "+".join(bodies)
        if each:
            scope = EACH if bodies == self.bodies else f"{EACH} of {scope}"
        name = f"{effect}@{scope}" if bodies else effect
        if name not in self.terms:
            shared: tuple[EffectParameter, ...] = (known.per_body or known).parameters
            cut = known.strengths
            own = [
                (f"{name}.{p.name}{'' if body is None else f' of {body}'}", p)
                for part in (shared[:cut], shared[cut:])
                for body in (bodies if each else (None,))
                for p in part
            ]
            made = [Parameter(n, max(p.start, p.lower), p.lower, p.upper, p.step) for n, p in own]
            cut *= len(bodies) if each else 1
            guesses = plain_term(effect, self._setting(self.observations[0])).guesses
            units = {n: p.unit for n, p in own}
            self.terms[name] = EffectTerm(name, effect, tuple(made[:cut]), tuple(made[cut:]), guesses, units, bodies)
        return self.terms[name]

    def own(self, term: EffectTerm, body: str) -> tuple[Parameter, ...]:
        """The parameters of ``term`` for one of its bodies."""
        return tuple(p for p in term.parameters if " of " not in p.name or p.name.endswith(f" of {body}"))

    def term(self, name: str) -> EffectTerm:
        """A term that ``candidates`` or ``made`` gave, or an effect of all."""
        return self.terms[name] if name in self.terms else self.made(name, ())

    def _setting(self, run: PointRun) -> EffectContext:
        rest = torch.zeros(1, 3, dtype=torch.float64)
        frame_time = float(np.median(np.diff(run.times)))
        return EffectContext(torch.as_tensor(self.gravity), rest, run.outline.mass, run.outline.diameter,
                       float(run.times[-1]), frame_time)  # fmt: skip

    def members(self, model: Model, values: Mapping[str, float], run: PointRun) -> list[tuple[Effect, np.ndarray]]:
        """Effects of ``model`` with their coefficients for ``run``, zero strength where none acts on its body."""
        setting, out, values = self._setting(run), [], {**self.given, **values}
        for name in dict.fromkeys(self.term(n).effect for n in model.effects):
            effect, theta = effect_named(name), None
            for term in (self.term(n) for n in model.effects):
                if term.effect == name and (not term.bodies or run.body in term.bodies):
                    given = torch.tensor([values[p.name] for p in self.own(term, run.body)], dtype=torch.float64)
                    theta = effect.per_body.of_body(given, run.outline) if effect.per_body else given
            if theta is None:
                absent = [0.0 if k < effect.strengths else p.start for k, p in enumerate(effect.parameters)]
                theta = torch.tensor(absent, dtype=torch.float64)
            out.append((effect, effect.coefficients(theta, setting).numpy()))
        return out

    # -- motion -------------------------------------------------------------------------------------------------

    def ballistic_positions(
        self, run: PointRun, members: list[tuple[Effect, np.ndarray]], starts: np.ndarray
    ) -> np.ndarray:
        """Places (B, K, A) [m, world, measured axes] at the run's times for ``starts`` (B, 2A): place, velocity of each
        measured axis in turn. Raises NonFiniteError."""
        self.rollouts += 1
        world = np.zeros((len(starts), 2, 3))
        for k, axis in enumerate(run.axes):
            world[:, :, axis] = starts[:, 2 * k : 2 * k + 2]
        paths = fly(self.frame, self.gravity, members, world, run.times, run.outline.diameter, self.substep)
        if not np.isfinite(paths).all():
            raise NonFiniteError(0, 0, f"the flight of {run.name} is not finite")
        return paths[:, :, list(run.axes)]

    def start_of(self, run: PointRun, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Place and velocity (2A,) at the first frame: among ``values``, or for a held-out run those nearest to it."""
        guess = run.starts()
        if run.fitted:
            return np.array([values[p.name] for p in guess])
        members = self.members(model, values, run)
        start, steps = np.array([p.start for p in guess]), np.array([p.step for p in guess])
        for _ in range(REFITS):
            flights = self.ballistic_positions(run, members, np.concatenate([start[None], start + np.diag(steps)]))
            slopes = ((flights[1:] - flights[0]) / steps[:, None, None]).reshape(len(steps), -1).T
            start = start + np.linalg.lstsq(slopes, (run.observed - flights[0]).ravel(), rcond=None)[0]
        return start

    def flight(self, run: PointRun, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Places (K, A) [m, world, measured axes] of the model at the run's times."""
        start = self.start_of(run, model, values)
        return self.ballistic_positions(run, self.members(model, values, run), start[None])[0]

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Simulated less observed (K, 1, A) [m] of each run; of a held-out run nothing but on request."""
        out = []
        for run in self.observations:
            if run.fitted or held_out:
                out.append((self.flight(run, model, values) - run.observed)[:, None])
            else:
                out.append(np.zeros((0, 1, len(run.axes))))
        return out

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Of the fitted runs, weighted, flat."""
        found = zip(self.observations, self.fields(model, values), strict=True)
        return np.concatenate([run.whiten(f).ravel() for run, f in found])

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """None: there is no grid, and a quarter of the substep changes less than a micrometre."""
        return []

    def by_body(self, model: Model, values: Mapping[str, float], *, fitted: bool) -> dict[str, float]:
        """Error [mm] of each body over its runs that are fitted, or that are held out."""
        fields = self.fields(model, values, held_out=True)
        own: dict[str, list[np.ndarray]] = {}
        for run, field in zip(self.observations, fields, strict=True):
            if run.fitted == fitted:
                own.setdefault(run.body, []).append(field)
        return {body: rms_mm(found) for body, found in own.items()}

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """As they are: no start is known but from a fit."""
        return dict(values)

    def curriculum(self, base: ModelFit) -> Sequence[PointSimulation]:
        """None: a flight has no phase to lose."""
        return ()

    def is_out_of_phase(self, base) -> bool:
        """Never: a flight has no phase to lose."""
        return False

    def _contradiction(self, fitted: ModelFit, term: EffectTerm, body: str) -> str | None:
        run = next(run for run in self.observations if run.body == body)
        theta = torch.tensor([fitted.values[p.name] for p in self.own(term, body)], dtype=torch.float64)
        per_body = effect_named(term.effect).per_body
        return per_body.violates_bounds(theta, run.outline) if per_body else None

    def objections(self, before: ModelFit, after: ModelFit, term: EffectTerm, config: RefineConfig) -> list[str]:
        """A term of all must make no body worse, one of some must make those better, on runs that were held out."""
        old, new = (self.by_body(f.model, f.values, fitted=False) for f in (before, after))
        out = [f"{b}: {why}" for b in term.bodies or self.bodies if (why := self._contradiction(after, term, b))]
        for body in old:
            share = 1 - new[body] / old[body]
            if term.bodies == (body,) and share < config.min_gain:
                out.append(f"{body}: {old[body]:.0f} mm held out become {new[body]:.0f} mm")
            elif share < -config.min_gain:
                out.append(f"{body} does not share it: {old[body]:.0f} mm held out become {new[body]:.0f} mm")
        return out


def fly(
    frame: SimulationFrame,
    gravity: np.ndarray,
    members: list[tuple[Effect, np.ndarray]],
    starts: np.ndarray,
    times: np.ndarray,
    diameter: float,
    substep: float = LONGEST_SUBSTEP,
) -> np.ndarray:
    """Places (B, K, 3) [m, world] of a mass point at ``times`` (K,) [s], the first of which is the start.

    starts (B, 2, 3): place [m] and velocity [m/s], world; gravity (3,) [m/s^2, simulation frame]; members: effects with
    their coefficients; diameter [m]; substep [s]: an upper bound.
    """
    begin = np.concatenate(
        [frame.points_to_simulation(starts[:, 0]), frame.vectors_to_simulation(starts[:, 1])], axis=1
    )
    gaps = np.diff(times, prepend=times[0])
    counts = np.maximum(np.ceil(gaps / substep), 1).astype(np.int32)
    out = np.zeros((len(starts), len(times), 3))
    coefficients = np.concatenate([c for _, c in members] or [np.zeros(1)])
    kernels = point_kernels(tuple((effect, len(c)) for effect, c in members))
    kernels.fly(
        np.ascontiguousarray(begin), np.ascontiguousarray(gravity, dtype=np.float64),
        np.tile(coefficients, (len(starts), 1)), times.astype(np.float64), counts, diameter, out,
    )  # fmt: skip
    return frame.points_to_world(out)
