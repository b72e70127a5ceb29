"""Simulate a twin, as it was filmed or as it never was."""

from __future__ import annotations

import os
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
    progress: Progress = silent,
) -> Motion:
    """The first ``frames`` frames of the twin's motion, frame 0 included.

    velocity (3,) [m/s], omega (3,) [rad/s], gravity (3,) [m/s^2], world frame, replace what was identified; fps the
    video's. Raises InputError for a value that is not finite or a frame count below 1, NonFiniteError where the motion
    diverges.
    """
    chosen = {"velocity": twin.velocity, "omega": twin.omega, "gravity": twin.gravity}
    for name, given in (("velocity", velocity), ("omega", omega), ("gravity", gravity)):
        if given is not None:
            if np.shape(given) != (3,) or not np.isfinite(given).all():
                raise InputError(f"--{name} takes three finite numbers X,Y,Z")
            chosen[name] = np.asarray(given, dtype=np.float64)
    if frames < 1:
        raise InputError(f"--frames {frames}: give at least 1")
    rate = twin.fps if fps is None else fps
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    turned = {name: axes.vectors_to_simulation(value) for name, value in chosen.items()}
    tensors = {k: torch.as_tensor(v, dtype=torch.float32) for k, v in turned.items()}
    start = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    state = thrown(start, tensors["velocity"], tensors["omega"])
    positions = [start]
    with runtime.torch_threads(1):
        for frame in range(1, frames):
            simulator, steps = _for_one_frame(twin, state, turned["gravity"], rate)
            recording = simulator.run(state, twin.law, steps, [steps])
            state = recording.final
            positions.append(recording.positions[0])
            progress("simulate", frame, frames - 1)
    world = axes.points_to_world(torch.stack(positions).numpy())
    return Motion(np.asarray(world, dtype=np.float32), np.arange(frames) / rate)


def _for_one_frame(twin: Twin, state: State, gravity: np.ndarray, fps: float) -> tuple[Simulator, int]:
    """A simulator and its number of substeps for the next frame: as many as the present speed asks for."""
    spacing = grid_spacing(twin.volume, len(twin.positions), twin.simulator)
    speed = float(state.velocity.norm(dim=1).max()) + float(np.linalg.norm(gravity)) / fps
    steps = substeps_per_frame(
        spacing=spacing,
        wave_modulus=twin.law.wave_modulus(),
        density=twin.density,
        speed=speed,
        frame_time=1 / fps,
        config=twin.simulator,
    )
    simulator = Simulator(
        particle_count=len(twin.positions),
        spacing=spacing,
        substep=1 / (fps * steps),
        volume=twin.volume,
        density=twin.density,
        gravity=gravity,
        contact=twin.contact if twin.ground is not None else "none",
        friction=twin.friction,
        memory_mb=twin.simulator.memory_mb,
        max_substeps=64,  # longer frames run in segments: one capacity, one compile
        grid_nodes=twin.simulator.grid_nodes,
        chunks=twin.simulator.chunks,
    )
    return simulator, steps
