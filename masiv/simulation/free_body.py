"""Rollouts of a deformable body that flies freely: a body that was filmed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.errors import InputError, NonFiniteError
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.design import NO_DEMAND, grid_spacing, substeps_per_frame
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.progress import Progress, silent
from masiv.scene.transforms import SimulationFrame
from masiv.simulation.force import ForcePulse
from masiv.simulation.particle_fields import ParticleFields, accelerates, fields_at, stacked
from masiv.simulation.rollout import Rollout
from masiv.simulation.subdivide import subdivide_twin
from masiv.simulation.twin_effects import active_effects, mass_ratio, shift_effects
from masiv.twin import Twin


def simulate_free_body(
    twin: Twin,
    *,
    frames: int,
    fps: float,
    force: ForcePulse | None = None,
    substeps: int | None = None,
    fields: bool = False,
    progress: Progress = silent,
) -> Rollout:
    """``frames`` frames at k / fps [s] of the only body of ``twin``, its particles subdivided.

    substeps: in a frame; as many as the present speed and the effects ask for if None. If the twin's clock is late,
    frames after the first are the states at the times when they were really taken, not before the start. fields: also
    those of the particles; between two states they are interpolated. Raises NonFiniteError.
    """
    twin = subdivide_twin(twin)
    effects = active_effects(twin, frames=frames, fps=fps)
    # Frame k is taken at the instant k + late, at a fraction (0, 1] of an interval between two whole frames.
    late = 0.0 if effects is None else float(effects.time_shift()) * fps
    ahead = math.ceil(late)
    fraction = late - (ahead - 1)
    intervals = frames - 1 + ahead
    positions: list[torch.Tensor] = []
    felt: list[ParticleFields] = []
    for interval, (state, observed) in enumerate(_intervals(twin, effects, intervals, fraction, fps, force, substeps)):
        if interval == 0:  # frames that would have been taken before the start show the start
            positions += [observed] * min(frames, 1 + max(0, -ahead))
        elif interval > ahead:
            positions.append(observed)
        if fields:
            felt.append(_fields(twin, effects, state, interval / fps, fps))
        if interval:
            progress("simulate", interval, intervals)
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    world = axes.points_to_world(torch.stack(positions).numpy())
    times = np.arange(frames) / fps
    index = np.clip(np.arange(frames) + late, 0, None) * (times > 0)
    found = stacked(felt).at(index) if fields else None
    return Rollout(np.asarray(world, dtype=np.float32), times, fields=found)


def iterate_states(twin: Twin, *, frames: int, fps: float, force: ForcePulse | None = None) -> Iterator[State]:
    """The state of the only body of ``twin`` at each k / fps [s], k < frames, in the simulation frame. A clock that is
    late changes when pictures were taken and nothing here. Raises InputError, NonFiniteError."""
    if frames < 1:
        raise InputError(f"--frames {frames}: give at least 1")
    effects = active_effects(twin, frames=frames, fps=fps)
    for state, _ in _intervals(twin, effects, frames - 1, 1.0, fps, force, None):
        yield state


def _intervals(
    twin: Twin,
    effects: ActiveEffects | None,
    intervals: int,
    fraction: float,
    fps: float,
    force: ForcePulse | None,
    substeps: int | None,
) -> Iterator[tuple[State, torch.Tensor]]:
    """The start, then for each interval of 1 / fps [s] the state at its end and positions (N, 3) at a ``fraction``
    (0, 1] of it, in the simulation frame."""
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    gravity = axes.vectors_to_simulation(twin.gravity)
    velocity, omega = (
        torch.as_tensor(axes.vectors_to_simulation(v), dtype=torch.float32) for v in (twin.velocity, twin.omega)
    )
    start = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    # The ground is the plane y = 0 of the simulation: raising it is lowering the body.
    raised = torch.zeros(3)
    if effects is not None:
        raised[1] = effects.ground_shift()
        effects = shift_effects(effects, raised[1])
    state = rigid_initial_state(start - raised, velocity, omega)
    yield replace(state, position=start), start
    done = 0
    for interval in range(intervals):
        begin, elapsed, observed = interval / fps, 0.0, None
        pieces = [(1 / fps, False)] if force is None else force.pieces(begin, (interval + 1) / fps)
        for duration, acts in pieces:
            acceleration = gravity
            if force is not None and acts:
                mass = twin.density * twin.volume * mass_ratio(effects)
                acceleration = acceleration + axes.vectors_to_simulation(force.force) / mass
            if substeps is None:
                steps = _substeps(twin, effects, state, acceleration, duration)
            else:
                steps = max(1, math.ceil(substeps * duration * fps - 1e-6))
            simulator = _simulator(twin, acceleration, duration / steps)
            place = (fraction / fps - elapsed) / duration * steps
            between = fraction < 1 and observed is None and place <= steps
            before = min(int(place), steps - 1)
            outputs = [before, before + 1] if between else []
            try:
                recording = simulator.run(state, twin.law, steps, outputs, effects, begin + elapsed)
            except NonFiniteError as error:  # whose substep is counted from ``state``
                raise NonFiniteError(done + error.substep, error.particle, error.detail) from error
            done += steps
            if between:  # between two substeps a particle moves in a straight line
                early, after = recording.positions
                observed = early + (place - before) * (after - early)
            state = recording.final
            elapsed += duration
        whole = replace(state, position=state.position + raised)
        yield whole, whole.position if observed is None else observed + raised


def _fields(twin: Twin, effects: ActiveEffects | None, state: State, time: float, fps: float) -> ParticleFields:
    """Of ``state`` at ``time`` [s], as ``_intervals`` gives them: the ground is where it was raised to."""
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    gravity = axes.vectors_to_simulation(twin.gravity)
    if effects is not None:
        raised = torch.zeros(3)
        raised[1] = effects.ground_shift()
        state, effects = replace(state, position=state.position - raised), shift_effects(effects, raised[1])
    steps = _substeps(twin, effects, state, gravity, 1 / fps)
    causes = [] if effects is None else [e for e, _ in effects.members if accelerates(e)]
    return fields_at(_simulator(twin, gravity, 1 / fps / steps), twin.law, state, effects, causes, time, axes)


def _substeps(
    twin: Twin, effects: ActiveEffects | None, state: State, acceleration: np.ndarray, duration: float
) -> int:  # fmt: skip
    """Substeps for the next ``duration`` [s]: as many as the present speed and the effects ask for.

    acceleration (3,) [m/s^2, simulation frame]: of gravity and of what else acts on all mass alike.
    """
    return substeps_per_frame(
        spacing=grid_spacing(twin.volume, len(twin.positions), twin.simulator),
        wave_modulus=twin.law.wave_modulus(),
        density=twin.density,
        speed=float(state.velocity.norm(dim=1).max()) + float(np.linalg.norm(acceleration)) * duration,
        frame_time=duration,
        config=twin.simulator,
        demand=NO_DEMAND if effects is None else effects.substep_demand(),
    )


def _simulator(twin: Twin, acceleration: np.ndarray, substep: float) -> Simulator:
    return Simulator(
        particle_count=len(twin.positions),
        spacing=grid_spacing(twin.volume, len(twin.positions), twin.simulator),
        substep=substep,
        volume=twin.volume,
        density=twin.density,
        gravity=acceleration,
        contact=twin.contact if twin.ground is not None else "none",
        friction=twin.friction,
        memory_mb=twin.simulator.memory_mb,
        max_substeps=64,  # longer frames run in segments: one capacity, one compile
        grid_nodes=twin.simulator.grid_nodes,
        chunks=twin.simulator.chunks,
    )
