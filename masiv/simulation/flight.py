"""Flights of rigid bodies: point masses under gravity and effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from masiv.effects.context import EffectContext
from masiv.effects.effect import Effect, NodalEffect
from masiv.errors import InputError, NonFiniteError
from masiv.models.point_mass import fly
from masiv.scene.transforms import SimulationFrame
from masiv.simulation.particle_fields import ParticleFields
from masiv.simulation.rollout import Rollout
from masiv.simulation.twin_effects import effect_members
from masiv.twin import Body, InitialCondition, Twin

INSTANT = 1e-4
"""Interval [s] over which velocities and accelerations are taken from places."""


@dataclass(frozen=True)
class _Flight:
    """A body, ready to fly. members: effects with their coefficients, simulation frame; begin (1, 2, 3): place [m] and
    velocity [m/s], world."""

    name: str
    frame: SimulationFrame
    gravity: np.ndarray
    members: list[tuple[Effect, np.ndarray]]
    begin: np.ndarray
    diameter: float

    def path(
        self, times: np.ndarray, begin: np.ndarray | None = None, members: list[tuple[Effect, np.ndarray]] | None = None
    ) -> np.ndarray:
        """(T, 3) [m, world] from ``begin`` at times[0]. Raises NonFiniteError."""
        start = self.begin if begin is None else begin
        acting = self.members if members is None else members
        path = fly(self.frame, self.gravity, acting, start, times, self.diameter)[0]
        if not np.isfinite(path).all():
            raise NonFiniteError(0, 0, f"the flight of {self.name} is not finite")
        return path

    def accelerations(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """By name of the effect, (T, 3) [m/s^2, world]: how much less the body falls in the next instant without it."""
        instants = np.concatenate([times, times + INSTANT, times + 2 * INSTANT])
        order = np.argsort(instants, kind="stable")
        places = np.empty((len(instants), 3))
        places[order] = self.path(instants[order])
        now, soon, later = np.split(places, 3)
        velocities = (4 * soon - 3 * now - later) / (2 * INSTANT)  # of second order
        out = {effect.name: np.zeros((len(times), 3)) for effect, _ in self.members}
        for k, time in enumerate(times):
            step = np.array([time, time + INSTANT])
            state = np.stack([now[k], velocities[k]])[None]
            whole = self.path(step, state)[1]
            for effect, _ in self.members:
                others = [member for member in self.members if member[0] is not effect]
                out[effect.name][k] = 2 * (whole - self.path(step, state, others)[1]) / INSTANT**2
        return out


@torch.no_grad()
def simulate_flight(
    twin: Twin, *, frames: int, fps: float, velocity: np.ndarray | None = None, fields: bool = False
) -> Rollout:
    """``frames`` frames at k / fps [s] of every body of ``twin``, from its first observation on. velocity (3,) [m/s,
    world] takes the place of what was identified, of all bodies. fields: also the accelerations that effects give.
    Raises InputError, NonFiniteError."""
    times = np.arange(frames) / fps
    starts: dict[str, InitialCondition] = {}
    for start in twin.initial_conditions:
        starts.setdefault(start.body, start)
    bodies = [body for body in twin.bodies if body.name in starts]
    flights = [_flight(twin, body, starts[body.name], times, velocity) for body in bodies]
    markers = np.stack([flight.path(times) for flight in flights], axis=1)
    felt = _accelerations(flights, times) if fields else None
    return Rollout(markers.astype(np.float32), times, markers, tuple(body.name for body in bodies), felt)


def _accelerations(flights: list[_Flight], times: np.ndarray) -> ParticleFields:
    given = [flight.accelerations(times) for flight in flights]
    names = dict.fromkeys(name for own in given for name in own)
    none = np.zeros((len(times), 3))
    found = {name: np.stack([own.get(name, none) for own in given], axis=1).astype(np.float32) for name in names}
    return ParticleFields(None, None, found)


def _flight(twin: Twin, body: Body, start: InitialCondition, times: np.ndarray, velocity: np.ndarray | None) -> _Flight:
    if start.placement is None or body.drag is None:
        raise InputError(f"body {body.name} needs a place in {start.observation} and a diameter to fly")
    frame = SimulationFrame.from_scene(twin.up, twin.ground)
    gravity = frame.vectors_to_simulation(twin.gravity)
    rest = torch.zeros(1, 3, dtype=torch.float64)
    duration, frame_time = float(times[-1]), float(times[1] - times[0]) if len(times) > 1 else 0.0
    context = EffectContext(
        torch.as_tensor(gravity), rest, body.drag.mass, body.drag.diameter, duration, frame_time
    )  # fmt: skip
    members: list[tuple[Effect, np.ndarray]] = []
    for effect, theta in effect_members(twin, body, torch.float64):
        if not isinstance(effect, NodalEffect):
            raise InputError(f"effect {effect.name} does not act on a rigid body: leave it out with --without")
        members.append((effect, effect.coefficients(theta, context).numpy()))
    begin = np.stack([start.placement.translation, start.velocity if velocity is None else velocity])[None]
    return _Flight(body.name, frame, gravity, members, begin.astype(np.float64), body.drag.diameter)
