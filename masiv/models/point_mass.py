"""Light rigid bodies in flight, each a mass point: what several of them share, and what each has of its own.

Gravity, wind and the like are shared by all; a drag is shared by all or belongs to one kind. A held-out run is
predicted from its own place and velocity at its first frame, which say nothing of the physics; all else comes from the
fitted runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from masiv import runtime
from masiv.effects.catalogue import causes, effect_named
from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import Effect, NodalEffect
from masiv.errors import NonFiniteError
from masiv.kernels.points import point_kernels
from masiv.models.base import EffectTerm, FittedModel, ForwardModel, Model, plain_term
from masiv.models.families import Family
from masiv.models.parameters import Parameter
from masiv.observations.base import rms_mm
from masiv.observations.tracks import TracksObservation
from masiv.scene.transforms import SimulationFrame
from masiv.tracks.tracks import Tracks
from masiv.twin.from_tracks import drag_body
from masiv.workers import Workers

RIGID = Family("rigid", (), {})
"""The law of a body that does not deform: nothing to fit."""
LONGEST_SUBSTEP = 5e-3
"""[s]"""
EACH = "each"
"""In the name of a term: every body has a strength of its own."""
NEWTON_STEPS = 4
"""Gauss-Newton steps for the start of a held-out run; without drag one is exact."""
START_FRAMES = 5
"""Frames from which the first guess of a velocity is."""
MIN_SIZE = 0.1
"""[m], of a flight, for the bounds of its start."""


def flight_parameters(run: TracksObservation) -> tuple[Parameter, ...]:
    """Place [m] and velocity [m/s] at the first frame, in the axes that were measured."""
    places = run.values[:, 0]
    first = places[0]
    slope = np.polynomial.polynomial.polyfit(run.times[:START_FRAMES], places[:START_FRAMES], 1)[1]
    size = max(float(np.ptp(places, axis=0).max()), MIN_SIZE)
    speed = size / run.times[-1]
    out = []
    for k, axis in enumerate(run.axes):
        a, x, v = "xyz"[axis], float(first[k]), float(slope[k])
        reach = 0.5 * size
        out.append(Parameter(f"position_{a}@{run.name}", x, x - reach, x + reach, 0.01 * size))
        out.append(Parameter(f"velocity_{a}@{run.name}", v, v - 2 * speed, v + 2 * speed, 0.05 * speed))
    return tuple(out)


class PointMassModel(ForwardModel):
    """Mass points of a group under gravity and effects."""

    observations: Sequence[TracksObservation]

    def __init__(
        self, tracks: Tracks, runs: Sequence[TracksObservation], known: Mapping[str, float] | None = None,
        substep: float = LONGEST_SUBSTEP,
    ) -> None:  # fmt: skip
        """runs: see ``flight_observations``. known: parameters of effects that are not fitted. substep [s]: the
        longest."""
        super().__init__(runs)
        self.tracks = tracks
        self.known = dict(known or {})
        self.frame = SimulationFrame.from_scene(tracks.up, tracks.ground)
        self.gravity = self.frame.vectors_to_simulation(tracks.gravity)
        self.bodies = tuple(dict.fromkeys(run.body for run in self.observations))
        self.drag_bodies = {body: drag_body(tracks, tracks.bodies[body]) for body in self.bodies}
        self.substep = substep
        self.terms: dict[str, EffectTerm] = {}

    def with_workers(self, workers: Workers) -> PointMassModel:
        """This one: a flight takes less than a message to another process."""
        return self

    # -- models -------------------------------------------------------------------------------------------------

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """The start of each fitted run, and the effects."""
        own = [p for run in self.observations if run.fitted for p in flight_parameters(run)]
        of_effects = [p for name in model.effects for p in self.term(name).parameters]
        return (*own, *(p for p in of_effects if p.name not in self.known))

    def single_body(self, body: str, model: Model, values: Mapping[str, float]) -> PointMassModel:
        """A model of the runs of ``body`` alone. The effects of ``model`` act with ``values``, which are not fitted."""
        known = {p.name: values[p.name] for name in model.effects for p in self.term(name).parameters}
        runs = [run for run in self.observations if run.body == body]
        made = PointMassModel(self.tracks, runs, {**self.known, **known}, self.substep)
        made.terms = dict(self.terms)
        return made

    def candidates(self, model: Model) -> list[str]:
        """Effects of the surroundings, one term each; of those that differ by body, a term for all bodies, one for each
        body and one with a strength of its own for each. What acts at a place is left out: a point passes it once."""
        out, taken = [], [self.term(name) for name in model.effects]
        for name, effect in causes().items():
            at_place = any(p.unit == "m" for p in effect.parameters[effect.strengths :])
            if at_place or not isinstance(effect, NodalEffect):
                continue
            has = [t for t in taken if t.effect == name]
            if not has:
                out.append(self.scoped_term(name, ()).name)
            differs = effect.per_body is not None and effect.per_body.differs_by_body
            if differs and len(self.bodies) > 1 and all(t.bodies for t in has):
                held = {b for t in has for b in t.bodies}
                fitted = {run.body for run in self.observations if run.fitted}
                alone = [b for b in self.bodies if b not in held and b in fitted]
                out += [self.scoped_term(name, (b,)).name for b in alone]
                if len(alone) > 1:
                    out.append(self.scoped_term(name, tuple(alone), each=True).name)
        return out

    def scoped_term(self, effect: str, bodies: tuple[str, ...], *, each: bool = False) -> EffectTerm:
        """The term of ``effect`` on ``bodies``, with one strength or, if ``each``, one strength a body. On all bodies
        with one strength if ``bodies`` is empty. Raises InputError for an unknown effect."""
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
            guesses = plain_term(effect, self._context(self.observations[0])).guesses
            if known.per_body is not None:
                guesses = tuple(known.per_body.guesses() or guesses)
            if each:
                guesses = tuple(guess * len(bodies) for guess in guesses)
            units = {n: p.unit for n, p in own}
            self.terms[name] = EffectTerm(name, effect, tuple(made[:cut]), tuple(made[cut:]), guesses, units, bodies)
        return self.terms[name]

    def effect_axes(self, index: int) -> SimulationFrame:
        """See ``ForwardModel``."""
        return self.frame

    def effect_gravity(self, index: int) -> np.ndarray:
        """See ``ForwardModel``."""
        return self.gravity

    def parameters_of(self, term: EffectTerm, body: str) -> tuple[Parameter, ...]:
        """The parameters of ``term`` for one of its bodies."""
        return tuple(p for p in term.parameters if " of " not in p.name or p.name.endswith(f" of {body}"))

    def term(self, name: str) -> EffectTerm:
        """A term that ``candidates`` or ``scoped_term`` has returned, or an effect on all bodies."""
        return self.terms[name] if name in self.terms else self.scoped_term(name, ())

    def _context(self, run: TracksObservation) -> EffectContext:
        body = self.drag_bodies[run.body]
        rest = torch.zeros(1, 3, dtype=torch.float64)
        frame_time = float(np.median(np.diff(run.times)))
        return EffectContext(torch.as_tensor(self.gravity), rest, body.mass, body.diameter,
                       float(run.times[-1]), frame_time)  # fmt: skip

    def members(
        self, model: Model, values: Mapping[str, float], run: TracksObservation
    ) -> list[tuple[Effect, np.ndarray]]:
        """Effects of ``model`` with their coefficients for ``run``, zero strength where none acts on its body."""
        setting, out, values = self._context(run), [], {**self.known, **values}
        for name in dict.fromkeys(self.term(n).effect for n in model.effects):
            effect, theta = effect_named(name), None
            for term in (self.term(n) for n in model.effects):
                if term.effect == name and (not term.bodies or run.body in term.bodies):
                    given = torch.tensor(
                        [values[p.name] for p in self.parameters_of(term, run.body)], dtype=torch.float64
                    )
                    theta = effect.per_body.of_body(given, self.drag_bodies[run.body]) if effect.per_body else given
            if theta is None:
                absent = [0.0 if k < effect.strengths else p.start for k, p in enumerate(effect.parameters)]
                theta = torch.tensor(absent, dtype=torch.float64)
            out.append((effect, effect.coefficients(theta, setting).numpy()))
        return out

    # -- motion -------------------------------------------------------------------------------------------------

    def ballistic_positions(
        self, run: TracksObservation, members: list[tuple[Effect, np.ndarray]], starts: np.ndarray
    ) -> np.ndarray:
        """Places (B, K, A) [m, world, measured axes] at the run's times for ``starts`` (B, 2A): place, velocity of each
        measured axis in turn. Raises NonFiniteError."""
        self.rollouts += 1
        world = np.zeros((len(starts), 2, 3))
        for k, axis in enumerate(run.axes):
            world[:, :, axis] = starts[:, 2 * k : 2 * k + 2]
        diameter = self.drag_bodies[run.body].diameter
        paths = fly(self.frame, self.gravity, members, world, run.times, diameter, self.substep)
        if not np.isfinite(paths).all():
            raise NonFiniteError(0, 0, f"the flight of {run.name} is not finite")
        return paths[:, :, list(run.axes)]

    def start_of(self, run: TracksObservation, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Place and velocity (2A,) at the first frame: among ``values``, or for a held-out run those nearest to it."""
        guess = flight_parameters(run)
        if run.fitted:
            return np.array([values[p.name] for p in guess])
        members = self.members(model, values, run)
        start, steps = np.array([p.start for p in guess]), np.array([p.step for p in guess])
        for _ in range(NEWTON_STEPS):
            flights = self.ballistic_positions(run, members, np.concatenate([start[None], start + np.diag(steps)]))
            slopes = ((flights[1:] - flights[0]) / steps[:, None, None]).reshape(len(steps), -1).T
            start = start + np.linalg.lstsq(slopes, (run.values[:, 0] - flights[0]).ravel(), rcond=None)[0]
        return start

    def nuisance(self, model: Model, values: Mapping[str, float], index: int) -> np.ndarray:
        """See ``ForwardModel``: by the start of a held-out run, which is found from the run itself."""
        run = self.observations[index]
        if run.fitted:
            return super().nuisance(model, values, index)
        start, steps = self.start_of(run, model, values), np.array([p.step for p in flight_parameters(run)])
        starts = np.concatenate([start[None], start + np.diag(steps)])
        flights = self.ballistic_positions(run, self.members(model, values, run), starts)
        return np.moveaxis((flights[1:] - flights[0]) / steps[:, None, None], 0, -1)[:, None]

    def flight(self, run: TracksObservation, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """Places (K, A) [m, world, measured axes] of the model at the run's times."""
        start = self.start_of(run, model, values)
        return self.ballistic_positions(run, self.members(model, values, run), start[None])[0]

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """See ``ForwardModel``; (K, 1, A) [m, world]."""
        return [
            run.residual(self.flight(run, model, values)[:, None] if run.fitted or held_out else run.values[:0])
            for run in self.observations
        ]

    def by_body(self, model: Model, values: Mapping[str, float], purpose: str) -> dict[str, float]:
        """Error [mm] of each body over its runs of that ``purpose`` (fit, hold_out or test)."""
        fields = self.fields(model, values, held_out=True)
        own: dict[str, list[np.ndarray]] = {}
        for run, field in zip(self.observations, fields, strict=True):
            if run.purpose == purpose:
                own.setdefault(run.body, []).append(field)
        return {body: rms_mm(found) for body, found in own.items()}

    def impossible(self, fitted: FittedModel, term: EffectTerm) -> list[str]:
        """What the medium cannot do to a body, and whether the flights are too short to tell the effect from others."""
        out = [f"{b}: {why}" for b in term.bodies or self.bodies if (why := self._forbidden(fitted, term, b))]
        body = (term.bodies or self.bodies)[0]
        theta = torch.tensor([fitted.values[p.name] for p in self.parameters_of(term, body)], dtype=torch.float64)
        duration = max(float(run.times[-1]) for run in self.observations if run.fitted)
        reason = effect_named(term.effect).hints.identifiability_issue(theta, duration, torch.zeros(0, 3))
        return out if reason is None else [*out, reason]

    def _forbidden(self, fitted: FittedModel, term: EffectTerm, body: str) -> str | None:
        """What the medium cannot do to ``body``."""
        theta = torch.tensor([fitted.values[p.name] for p in self.parameters_of(term, body)], dtype=torch.float64)
        per_body = effect_named(term.effect).per_body
        return per_body.violates_bounds(theta, self.drag_bodies[body]) if per_body else None


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
    runtime.check_float64("the flight of a mass point")
    kernels = point_kernels(tuple((effect, len(c)) for effect, c in members))
    kernels.fly(
        np.ascontiguousarray(begin), np.ascontiguousarray(gravity, dtype=np.float64),
        np.tile(coefficients, (len(starts), 1)), times.astype(np.float64), counts, diameter, out,
    )  # fmt: skip
    return frame.points_to_world(out)
