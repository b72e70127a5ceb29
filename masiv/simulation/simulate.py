"""Simulate a twin, as it was filmed or as it never was."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv import runtime
from masiv.effects.active import ActiveEffects
from masiv.errors import InputError, NonFiniteError
from masiv.files import write_npz
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.design import grid_spacing, substeps_per_frame
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.progress import Progress, silent
from masiv.scene.transforms import SimulationFrame
from masiv.simulation.subdivide import finer
from masiv.simulation.twin_effects import active_effects, lowered, mass_ratio
from masiv.simulation.variation import without_effects

if TYPE_CHECKING:
    from masiv.twin import Twin


@dataclass(frozen=True)
class Rollout:
    """positions (T, Q, 3) float32 [m, world] in frames stamped times (T,) [s]."""

    positions: np.ndarray
    times: np.ndarray

    def save(self, path: Path) -> None:
        """Write ``path`` (.npz), complete or not at all."""
        write_npz(path, positions=self.positions, times=self.times)


@dataclass(frozen=True)
class Push:
    """A force (3,) [N, world] on the whole body, spread evenly over its mass, from ``start`` to ``stop`` [s]."""

    force: np.ndarray
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        if np.shape(self.force) != (3,) or not np.isfinite(self.force).all():
            raise InputError("--force takes three finite numbers X,Y,Z [N]")
        if not (math.isfinite(self.start) and self.start >= 0):
            raise InputError(f"--force-from {self.start:g}: give a time [s] of 0 or later")
        if not self.stop > self.start:
            raise InputError(f"--force-until {self.stop:g} must be later than --force-from {self.start:g}")

    def pieces(self, begin: float, end: float) -> list[tuple[float, bool]]:
        """The time from ``begin`` to ``end`` [s], cut where the force comes or goes: (duration [s], does it act)."""
        shortest = 1e-6 * (end - begin)  # a sliver of time is the error of a float, not a piece
        inside = [t for t in (self.start, self.stop) if begin + shortest < t < end - shortest]
        cuts = [begin, *inside, end]
        return [(b - a, self.start < 0.5 * (a + b) < self.stop) for a, b in itertools.pairwise(cuts)]


def simulate(
    twin: Twin,
    *,
    frames: int,
    fps: float | None = None,
    velocity: np.ndarray | None = None,
    omega: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    push: Push | None = None,
    without: tuple[str, ...] = (),
    substeps: int | None = None,
    progress: Progress = silent,
) -> Rollout:
    """The first ``frames`` frames of the twin's motion, frame 0 included, its particles in ``simulator.split`` parts.

    velocity (3,) [m/s], omega (3,) [rad/s], gravity (3,) [m/s^2], world frame, replace what was identified; fps the
    video's. push: a force for a while. without: names of effects of the twin that are not to act. substeps: in a frame;
    as many as the present speed asks for where None. Where the twin's clock is off, frames after the first are the
    states at the times when they would have been taken, not before the start. Raises InputError for a value that is not
    finite, a frame count below 1, an effect that the twin does not have or a push that starts after the last frame,
    NonFiniteError where the motion diverges.
    """
    if frames < 1:
        raise InputError(f"--frames {frames}: give at least 1")
    if substeps is not None and substeps < 1:
        raise InputError(f"substeps {substeps}: give at least 1")
    rate = twin.fps if fps is None else fps
    if push is not None and push.start >= (frames - 1) / rate:
        raise InputError(f"--force-from {push.start:g}: the last frame is at {(frames - 1) / rate:.3g} s")
    twin = finer(without_effects(twin, without))
    changes = _vectors(velocity=velocity, omega=omega, gravity=gravity)
    effects = active_effects(twin, frames=frames, fps=rate, gravity=changes.get("gravity"))
    # Frame k is taken at the instant k + late, a share (0, 1] into an interval between two whole frames.
    late = 0.0 if effects is None else float(effects.time_shift()) * rate
    ahead = math.ceil(late)
    share = late - (ahead - 1)
    intervals = frames - 1 + ahead
    positions: list[torch.Tensor] = []
    with runtime.torch_threads(1):
        timeline = _timeline(twin, effects, intervals, share, rate, push, substeps, changes)
        for interval, (_, seen) in enumerate(timeline):
            if interval == 0:  # frames that would have been taken before the start show the start
                positions += [seen] * min(frames, 1 + max(0, -ahead))
            elif interval > ahead:
                positions.append(seen)
            if interval:
                progress("simulate", interval, intervals)
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    world = axes.points_to_world(torch.stack(positions).numpy())
    return Rollout(np.asarray(world, dtype=np.float32), np.arange(frames) / rate)


def march(
    twin: Twin,
    *,
    frames: int,
    fps: float,
    velocity: np.ndarray | None = None,
    omega: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    push: Push | None = None,
) -> Iterator[State]:
    """The state at each k / fps, k < frames, in the simulation frame; a clock that is off changes when pictures were
    taken and nothing here. Arguments and errors as of ``simulate``."""
    if frames < 1:
        raise InputError(f"--frames {frames}: give at least 1")
    changes = _vectors(velocity=velocity, omega=omega, gravity=gravity)
    effects = active_effects(twin, frames=frames, fps=fps, gravity=changes.get("gravity"))
    for state, _ in _timeline(twin, effects, frames - 1, 1.0, fps, push, None, changes):
        yield state


def _timeline(
    twin: Twin,
    effects: ActiveEffects | None,
    intervals: int,
    share: float,
    fps: float,
    push: Push | None,
    substeps: int | None,
    changes: dict[str, np.ndarray],
) -> Iterator[tuple[State, torch.Tensor]]:
    """The start, then for each interval of 1 / fps [s] the state at its end and positions (N, 3) at a ``share`` (0, 1]
    of it, in the simulation frame. changes: to the twin's velocity, omega, gravity, world frame."""
    chosen = {"velocity": twin.velocity, "omega": twin.omega, "gravity": twin.gravity} | changes
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    turned = {name: axes.vectors_to_simulation(value) for name, value in chosen.items()}
    tensors = {k: torch.as_tensor(v, dtype=torch.float32) for k, v in turned.items()}
    start = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    # The ground is the plane y = 0 of the simulation: raising it is lowering the body.
    raised = torch.zeros(3)
    if effects is not None:
        raised[1] = effects.ground_shift()
        effects = lowered(effects, raised[1])
    state = rigid_initial_state(start - raised, tensors["velocity"], tensors["omega"])
    yield replace(state, position=start), start
    done = 0
    for interval in range(intervals):
        begin, elapsed, seen = interval / fps, 0.0, None
        pieces = [(1 / fps, False)] if push is None else push.pieces(begin, (interval + 1) / fps)
        for duration, pushed in pieces:
            acceleration = turned["gravity"]
            if pushed:
                mass = twin.density * twin.volume * mass_ratio(effects)
                acceleration = acceleration + axes.vectors_to_simulation(push.force) / mass
            if substeps is None:
                steps = _substeps(twin, state, acceleration, duration)
            else:
                steps = max(1, math.ceil(substeps * duration * fps - 1e-6))
            simulator = _simulator(twin, acceleration, duration / steps)
            place = (share / fps - elapsed) / duration * steps
            between = share < 1 and seen is None and place <= steps
            before = min(int(place), steps - 1)
            outputs = [before, before + 1] if between else []
            try:
                recording = simulator.run(state, twin.law, steps, outputs, effects, begin + elapsed)
            except NonFiniteError as error:  # whose substep is counted from ``state``
                raise NonFiniteError(done + error.substep, error.particle, error.detail) from error
            done += steps
            if between:  # between two substeps a particle moves in a straight line
                early, after = recording.positions
                seen = early + (place - before) * (after - early)
            state = recording.final
            elapsed += duration
        whole = replace(state, position=state.position + raised)
        yield whole, whole.position if seen is None else seen + raised


def _vectors(**given: np.ndarray | None) -> dict[str, np.ndarray]:
    """Those that are given, checked."""
    for name, value in given.items():
        if value is not None and (np.shape(value) != (3,) or not np.isfinite(value).all()):
            raise InputError(f"--{name} takes three finite numbers X,Y,Z")
    return {name: np.asarray(value, dtype=np.float64) for name, value in given.items() if value is not None}


def _substeps(twin: Twin, state: State, acceleration: np.ndarray, duration: float) -> int:
    """Substeps for the next ``duration`` [s]: as many as the present speed asks for.

    acceleration (3,) [m/s^2, simulation frame]: of gravity and of what else acts on all mass alike.
    """
    return substeps_per_frame(
        spacing=grid_spacing(twin.volume, len(twin.positions), twin.simulator),
        wave_modulus=twin.law.wave_modulus(),
        density=twin.density,
        speed=float(state.velocity.norm(dim=1).max()) + float(np.linalg.norm(acceleration)) * duration,
        frame_time=duration,
        config=twin.simulator,
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
