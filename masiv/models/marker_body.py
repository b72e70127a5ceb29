"""A measured body in the simulator: particles, clamp, rest and release."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.context import EffectContext
from masiv.errors import InputError
from masiv.models.attachment import Attachment, attach
from masiv.models.release import clamp_axes, static_deflection
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing, substeps_per_frame
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame
from masiv.tracks.geometry import fill_geometry
from masiv.tracks.placement import Placement
from masiv.tracks.tracks import Clamp, Run, Tracks

if TYPE_CHECKING:
    from masiv.materials.law import Law


@dataclass(frozen=True)
class SimulatedBody:
    """A body of a run at rest, ready to be let go. particles (N, 3) float64 [m, simulation frame]; volume [m³];
    density [kg/m³]; spacing of the grid [m]; frame: world -> simulation; gravity (3,) [m/s², simulation frame];
    contact with the ground; normals (P, 3), heights (P,) [m, simulation frame] of the clamp (P = 0: none);
    attachment: of ``markers``, the run's markers that move with the material (indices into ``run.markers``)."""

    particles: torch.Tensor
    volume: float
    density: float
    spacing: float
    frame: SimulationFrame
    gravity: np.ndarray
    contact: str
    normals: torch.Tensor
    heights: torch.Tensor
    attachment: Attachment
    markers: tuple[int, ...]

    @property
    def mass(self) -> float:
        """[kg]"""
        return self.density * self.volume

    @property
    def size(self) -> float:
        """Longest side [m] of the particles' bounding box."""
        return float((self.particles.max(0).values - self.particles.min(0).values).max())

    def released(self, dtype: torch.dtype = torch.float32, deflection: float = 0.0) -> State:
        """State at the release: at rest. It is stress-free if ``deflection`` [m] is 0, else bent as by its weight."""
        x = self.particles.double()
        gradient = torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)
        axes = clamp_axes(self.gravity, self.normals)
        if axes is not None and deflection != 0:
            x, gradient = static_deflection(x, self.heights[0], axes, deflection)
        still = torch.zeros_like(x, dtype=dtype)
        return replace(at_rest(x.to(dtype), still, torch.zeros_like(gradient, dtype=dtype)),
                       trial_gradient=gradient.to(dtype).contiguous())  # fmt: skip

    def effects(self, members: tuple = (), *, duration: float, frame_time: float) -> ActiveEffects:
        """Effects with their parameters, and after them the clamp."""
        from masiv.effects.boundary.clamp import with_clamp

        x = self.particles
        gravity = torch.as_tensor(self.gravity, dtype=x.dtype)
        setting = EffectContext(gravity, x, self.mass / len(x), self.size, duration, frame_time)
        active = ActiveEffects(tuple(members), setting)
        return with_clamp(active, self.normals, self.heights) if len(self.heights) else active

    def markers_to_world(self, positions: torch.Tensor) -> np.ndarray:
        """Particles (T, N, 3) [m, simulation frame] -> markers (T, len(markers), 3) [m, world]."""
        return self.frame.points_to_world(self.attachment.apply(positions.detach().double()).numpy())


def simulated_body(
    tracks: Tracks, run: Run, config: SimulatorConfig, *, particle_spacing: float, contact: str = "sticky"
) -> SimulatedBody:
    """The body of ``run`` filled with particles ``particle_spacing`` [m] apart, see ``placed_body``. Raises InputError
    if the scene does not say what is needed."""
    body = tracks.bodies[run.body]
    if body.geometry is None or body.density is None or run.placement is None:
        raise InputError(f"{tracks.path}: body {body.name} needs a geometry, and a density or a mass, to be simulated")
    free = body.free_markers(run)
    if not free:
        raise InputError(f"run {run.name}: no marker with all three axes moves with the material")
    return placed_body(
        fill_geometry(body.geometry, particle_spacing),
        body.geometry.volume,
        body.density,
        config,
        particle_spacing=particle_spacing,
        placement=run.placement,
        clamp=body.clamp,
        at_rest=run.at_rest[list(free)],
        markers=free,
        up=tracks.up,
        gravity=tracks.gravity,
        ground=tracks.ground,
        contact=contact if tracks.ground is not None else "none",
    )


def placed_body(
    own: np.ndarray,
    volume: float,
    density: float,
    config: SimulatorConfig,
    *,
    particle_spacing: float,
    placement: Placement,
    clamp: Clamp | None,
    at_rest: np.ndarray,
    markers: tuple[int, ...],
    up: np.ndarray,
    gravity: np.ndarray,
    ground: Ground | None,
    contact: str,
) -> SimulatedBody:
    """Particles ``own`` (N, 3) [m, own axes], ``particle_spacing`` [m] apart, at a place in the world, and markers tied
    to them that are ``at_rest`` (M, 3) [m, world]. up (3,) and gravity (3,) [m/s^2]: world.

    The grid holds ``config.particles_per_cell`` of them a cell. Without a ground it runs along the body's own axes, a
    plane of its nodes in each face of the clamp's first plane, so that neither is blurred.
    """
    spacing = grid_spacing(volume, len(own), config)
    frame = _along_body(placement.rotation, up) if ground is None else SimulationFrame.from_scene(up, ground)
    normals, heights = np.zeros((0, 3)), np.zeros(0)
    if clamp is not None:
        in_world = clamp.normals @ placement.rotation.T
        heights = clamp.heights + in_world @ placement.translation
        normals = frame.vectors_to_simulation(in_world)
        heights = heights + normals @ frame.translation
    if ground is None:
        frame, heights = _on_nodes(frame, placement.to_world(own), normals, heights, spacing)
    particles = frame.points_to_simulation(placement.to_world(own))
    return SimulatedBody(
        particles=torch.as_tensor(particles),
        volume=volume,
        density=density,
        spacing=spacing,
        frame=frame,
        gravity=frame.vectors_to_simulation(gravity),
        contact=contact,
        normals=torch.as_tensor(normals),
        heights=torch.as_tensor(heights),
        attachment=attach(particles, frame.points_to_simulation(at_rest), particle_spacing),
        markers=markers,
    )


def _along_body(rotation: np.ndarray, up: np.ndarray) -> SimulationFrame:
    """Axes along those of the body, the one nearest to ``up`` as y."""
    to_own = rotation.T
    best, nearest = np.eye(3), -math.inf
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs) @ np.eye(3)[list(order)] @ to_own
            score = float((turn @ up)[1]) + 1e-3 * float(np.trace(turn))
            if np.linalg.det(turn) > 0 and score > nearest:
                best, nearest = turn, score
    return SimulationFrame(best, np.zeros(3))


def _on_nodes(
    frame: SimulationFrame, world: np.ndarray, normals: np.ndarray, heights: np.ndarray, spacing: float
) -> tuple[SimulationFrame, np.ndarray]:
    """Shift ``frame`` so that nodes lie in the first plane of the clamp, and in the body's middle otherwise."""
    points = frame.points_to_simulation(world)
    shift = -0.5 * (points.max(0) + points.min(0))
    if len(heights):
        along = int(np.abs(normals[0]).argmax())
        if abs(normals[0, along]) > 1 - 1e-6:
            shift[along] = -heights[0] * np.sign(normals[0, along])
    return SimulationFrame(frame.rotation, frame.translation + shift), heights + normals @ shift


@dataclass(frozen=True)
class Plan:
    """A rollout to the times of a run: ``steps`` substeps, of which ``outputs`` fall on the times to within half a
    substep."""

    simulator: Simulator
    steps: int
    outputs: list[int]


def plan(
    body: SimulatedBody,
    law: Law,
    times: np.ndarray,
    config: SimulatorConfig,
    *,
    speed: float = 1.0,
    dtype: torch.dtype = torch.float32,
    substep: float | None = None,
) -> Plan:
    """How to simulate from the release to ``times`` (T,) [s since then, ascending], up to ``speed`` [m/s].

    ``substep`` [s] takes the place of the one that ``config`` gives.
    """
    if times[0] < 0 or not times[-1] > 0:
        raise InputError("a simulation runs from the release on: give times from 0 s, such as those of run.moving()")
    last = float(times[-1])
    if substep is None:
        frame_time = last / max(len(times) - 1, 1)
        count = substeps_per_frame(
            spacing=body.spacing,
            wave_modulus=law.wave_modulus(),
            density=body.density,
            speed=speed,
            frame_time=frame_time,
            config=config,
        )
        substep = frame_time / count
    outputs = [round(float(t) / substep) for t in times]
    simulator = Simulator(
        particle_count=len(body.particles),
        spacing=body.spacing,
        substep=substep,
        volume=body.volume,
        density=body.density,
        gravity=body.gravity,
        contact=body.contact,
        dtype=dtype,
        memory_mb=config.memory_mb,
        max_substeps=256,
        grid_nodes=config.grid_nodes,
        chunks=config.chunks,
    )
    return Plan(simulator, outputs[-1], outputs)


def simulated_markers(
    body: SimulatedBody, law: Law, times: np.ndarray, config: SimulatorConfig, members: tuple = (), **how
) -> np.ndarray:
    """Markers (T, len(body.markers), 3) [m, world] at ``times`` (T,) [s since the release], not differentiated.

    members: effects with their parameters; how: see ``plan``.
    """
    planned = plan(body, law, times, config, **how)
    duration = float(times[-1])
    effects = body.effects(members, duration=duration, frame_time=duration / max(len(times) - 1, 1))
    with torch.no_grad():
        state = body.released(planned.simulator.dtype)
        positions = rollout(planned.simulator, law, state, planned.steps, sorted(set(planned.outputs)), effects)
    row = {step: k for k, step in enumerate(sorted(set(planned.outputs)))}
    return body.markers_to_world(positions[[row[step] for step in planned.outputs]])
