"""Flights of rigid bodies: point masses under gravity and effects."""

from __future__ import annotations

import numpy as np
import torch

from masiv.effects.context import EffectContext
from masiv.effects.effect import NodalEffect
from masiv.errors import InputError, NonFiniteError
from masiv.models.point_mass import fly
from masiv.scene.transforms import SimulationFrame
from masiv.simulation.rollout import Rollout
from masiv.simulation.twin_effects import effect_members
from masiv.twin import Body, InitialCondition, Twin


@torch.no_grad()
def simulate_flight(twin: Twin, *, frames: int, fps: float, velocity: np.ndarray | None = None) -> Rollout:
    """``frames`` frames at k / fps [s] of every body of ``twin``, from its first observation on. velocity (3,) [m/s,
    world] takes the place of what was identified, of all bodies. Raises InputError, NonFiniteError."""
    times = np.arange(frames) / fps
    starts: dict[str, InitialCondition] = {}
    for start in twin.initial_conditions:
        starts.setdefault(start.body, start)
    bodies = [body for body in twin.bodies if body.name in starts]
    paths = [_flight(twin, body, starts[body.name], times, velocity) for body in bodies]
    markers = np.stack(paths, axis=1)
    return Rollout(markers.astype(np.float32), times, markers, tuple(body.name for body in bodies))


def _flight(
    twin: Twin, body: Body, start: InitialCondition, times: np.ndarray, velocity: np.ndarray | None
) -> np.ndarray:
    """(T, 3) [m, world]."""
    if start.placement is None or body.drag is None:
        raise InputError(f"body {body.name} needs a place in {start.observation} and a diameter to fly")
    frame = SimulationFrame.from_scene(twin.up, twin.ground)
    gravity = frame.vectors_to_simulation(twin.gravity)
    rest = torch.zeros(1, 3, dtype=torch.float64)
    duration, frame_time = float(times[-1]), float(times[1] - times[0]) if len(times) > 1 else 0.0
    context = EffectContext(
        torch.as_tensor(gravity), rest, body.drag.mass, body.drag.diameter, duration, frame_time
    )  # fmt: skip
    members = []
    for effect, theta in effect_members(twin, body, torch.float64):
        if not isinstance(effect, NodalEffect):
            raise InputError(f"effect {effect.name} does not act on a rigid body: leave it out with --without")
        members.append((effect, effect.coefficients(theta, context).numpy()))
    begin = np.stack([start.placement.translation, start.velocity if velocity is None else velocity])[None]
    path = fly(frame, gravity, members, begin.astype(np.float64), times, body.drag.diameter)[0]
    if not np.isfinite(path).all():
        raise NonFiniteError(0, 0, f"the flight of {body.name} is not finite")
    return path
