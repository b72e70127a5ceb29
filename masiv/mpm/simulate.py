"""Simulate a twin, as it was filmed or as it never was."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv import runtime
from masiv.errors import InputError
from masiv.mpm.design import grid_spacing, substeps_per_frame
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator, State
from masiv.progress import Progress, silent
from masiv.scene.transforms import SimulationFrame

if TYPE_CHECKING:
    from masiv.twin import Twin


@dataclass(frozen=True)
class Motion:
    """positions (T, Q, 3) float32 [m, world] at times (T,) [s]."""

    positions: np.ndarray
    times: np.ndarray

    def save(self, path: Path) -> None:
        """Write ``path`` (.npz), complete or not at all."""
        temporary = path.with_suffix(".tmp.npz")
        np.savez_compressed(temporary, positions=self.positions, times=self.times)
        os.replace(temporary, path)


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


def skew(omega: torch.Tensor) -> torch.Tensor:
    """The matrix W (3, 3) with W r = omega x r."""
    x, y, z = omega.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def thrown(position: torch.Tensor, velocity: torch.Tensor, omega: torch.Tensor) -> State:
    """An undeformed body (N, 3) [m] with the velocity (3,) [m/s] of its centroid and a spin (3,) [rad/s] about it."""
    spin = skew(omega)
    arm = position - position.mean(0)
    return at_rest(position, velocity + arm @ spin.T, spin.expand(len(position), 3, 3))


def simulate(
    twin: Twin,
    *,
    frames: int,
    fps: float | None = None,
    velocity: np.ndarray | None = None,
    omega: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    push: Push | None = None,
    progress: Progress = silent,
) -> Motion:
    """The first ``frames`` frames of the twin's motion, frame 0 included.

    velocity (3,) [m/s], omega (3,) [rad/s], gravity (3,) [m/s^2], world frame, replace what was identified; fps the
    video's. push: a force for a while. Raises InputError for a value that is not finite, a frame count below 1 or a
    push that starts after the last frame, NonFiniteError where the motion diverges.
    """
    rate = twin.fps if fps is None else fps
    if push is not None and push.start >= (frames - 1) / rate:
        raise InputError(f"--force-from {push.start:g}: the last frame is at {(frames - 1) / rate:.3g} s")
    positions = []
    changes = {"velocity": velocity, "omega": omega, "gravity": gravity}
    with runtime.torch_threads(1):
        for frame, state in enumerate(march(twin, frames=frames, fps=rate, push=push, **changes)):
            positions.append(state.position)
            if frame:
                progress("simulate", frame, frames - 1)
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    world = axes.points_to_world(torch.stack(positions).numpy())
    return Motion(np.asarray(world, dtype=np.float32), np.arange(frames) / rate)


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
    """The state at each frame, in the simulation frame. Arguments and errors as of ``simulate``."""
    chosen = {"velocity": twin.velocity, "omega": twin.omega, "gravity": twin.gravity}
    for name, given in (("velocity", velocity), ("omega", omega), ("gravity", gravity)):
        if given is not None:
            if np.shape(given) != (3,) or not np.isfinite(given).all():
                raise InputError(f"--{name} takes three finite numbers X,Y,Z")
            chosen[name] = np.asarray(given, dtype=np.float64)
    if frames < 1:
        raise InputError(f"--frames {frames}: give at least 1")
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    turned = {name: axes.vectors_to_simulation(value) for name, value in chosen.items()}
    tensors = {k: torch.as_tensor(v, dtype=torch.float32) for k, v in turned.items()}
    start = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    state = thrown(start, tensors["velocity"], tensors["omega"])
    yield state
    for frame in range(1, frames):
        pieces = [(1 / fps, False)] if push is None else push.pieces((frame - 1) / fps, frame / fps)
        for duration, pushed in pieces:
            acceleration = turned["gravity"]
            if pushed:
                acceleration = acceleration + axes.vectors_to_simulation(push.force) / (twin.density * twin.volume)
            simulator, steps = _for_a_while(twin, state, acceleration, duration)
            state = simulator.run(state, twin.law, steps, []).final
        yield state


def _for_a_while(twin: Twin, state: State, acceleration: np.ndarray, duration: float) -> tuple[Simulator, int]:
    """A simulator and its number of substeps for the next ``duration`` [s]: as many as the present speed asks for.

    acceleration (3,) [m/s^2, simulation frame]: of gravity and of what else acts on all mass alike.
    """
    spacing = grid_spacing(twin.volume, len(twin.positions), twin.simulator)
    speed = float(state.velocity.norm(dim=1).max()) + float(np.linalg.norm(acceleration)) * duration
    steps = substeps_per_frame(
        spacing=spacing,
        wave_modulus=twin.law.wave_modulus(),
        density=twin.density,
        speed=speed,
        frame_time=duration,
        config=twin.simulator,
    )
    simulator = Simulator(
        particle_count=len(twin.positions),
        spacing=spacing,
        substep=duration / steps,
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
    return simulator, steps
