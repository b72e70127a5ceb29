"""A measured body in the simulator: particles, clamp, the markers tied to it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.errors import InputError, MasivError
from masiv.materials.law import Law
from masiv.models.attachment import Attachment, attach
from masiv.models.deformable import DeformableBody, checked_instants
from masiv.models.release import clamp_axes, static_deflection
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import State
from masiv.scene.transforms import SimulationFrame
from masiv.tracks.geometry import Geometry
from masiv.tracks.tracks import Run, Tracks

MIN_PARTICLES = 8
TILT_WEIGHT = 1e-3
"""Of the rotation's trace beside the height of y, so that equal choices of axes are decided."""


def fill_geometry(geometry: Geometry, spacing: float) -> np.ndarray:
    """Particles (N, 3) [m, own axes] about ``spacing`` [m] apart: the middles of cells that divide the bounding box
    evenly, if they are inside. Each stands for volume / N. Raises MasivError if fewer than 8 are."""
    counts = np.maximum(np.rint((geometry.upper - geometry.lower) / spacing).astype(int), 1)
    centres, inside = geometry.lattice_inside(counts)
    if inside.sum() < MIN_PARTICLES:
        raise MasivError(f"the body is thinner than the particle spacing {1e3 * spacing:.2g} mm: choose a smaller one")
    return centres[inside]


@dataclass(frozen=True, kw_only=True)
class MarkedBody(DeformableBody):
    """A body that is let go from rest, with markers that are tied to its material.

    contact: with the ground; attachment: of ``markers``, the run's markers that move with the material (indices into
    ``run.markers``). particles: float64.
    """

    contact: str
    attachment: Attachment
    markers: tuple[int, ...]

    @property
    def clamp_axes(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """See ``masiv.models.release.clamp_axes``."""
        return clamp_axes(self.gravity, self.normals)

    def released(self, dtype: torch.dtype = torch.float32, deflection: float = 0.0) -> State:
        """State at the release: at rest. It is stress-free if ``deflection`` [m] is 0, else bent as by its weight."""
        x = self.particles.double()
        gradient = torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)
        axes = self.clamp_axes
        if axes is not None and deflection != 0:
            x, gradient = static_deflection(x, self.heights[0], axes, deflection)
        still = torch.zeros_like(x, dtype=dtype)
        state = at_rest(x.to(dtype), still, torch.zeros_like(gradient, dtype=dtype))
        return replace(state, trial_gradient=gradient.to(dtype).contiguous())

    def markers_to_world(self, positions: torch.Tensor) -> np.ndarray:
        """Particles (T, N, 3) [m, simulation axes] -> markers (T, len(markers), 3) [m, world]."""
        return self.axes.points_to_world(self.attachment.apply(positions.detach().double()).numpy())

    def substep(self, law: Law, times: np.ndarray) -> float:
        """The longest [s] that divides the mean interval of ``times`` (T,) [s] evenly and that ``law`` is stable with.
        Raises MasivError if an interval needs too many, InputError for times that do not ascend from 0."""
        interval = float(checked_instants(times)[-1]) / max(len(times) - 1, 1)
        return interval / self.substeps(law, interval)

    def run(
        self,
        law: Law,
        times: np.ndarray,
        effects: ActiveEffects | None = None,
        *,
        substep: float | None = None,
        deflection: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> tuple[np.ndarray, torch.Tensor]:
        """Instants (T,) [s since the release], the ends of the substeps nearest to ``times`` (T,) [s]; and positions
        (T, N, 3) [m, simulation axes] there.

        effects: with the clamp, see ``DeformableBody.effects``; the clamp alone if None. substep [s]: see ``substep``.
        deflection: see ``released``. Raises NonFiniteError, and as ``substep``.
        """
        times = checked_instants(times)
        duration = float(times[-1])
        effects = effects or self.effects((), self.context(duration, duration / max(len(times) - 1, 1)))
        substep = substep or self.substep(law, times)
        outputs = [round(float(t) / substep) for t in times]
        state = self.released(dtype, deflection)
        positions = self.rollout(law, state, outputs, substep=substep, contact=self.contact, effects=effects)
        return np.array(outputs) * substep, positions


def marked_body(
    tracks: Tracks,
    run: Run,
    config: SimulatorConfig,
    *,
    particle_spacing: float,
    contact: str = "sticky",
    speed: float = 1.0,
) -> MarkedBody:
    """The body of ``run`` filled with particles ``particle_spacing`` [m] apart, at its place in that run.

    The grid holds ``config.particles_per_cell`` of them a cell. Without a ground it runs along the body's own axes, a
    plane of its nodes in each face of the clamp's first plane, so that neither is blurred. speed [m/s]: the greatest
    that the substep allows for. Raises InputError if the scene does not say what is needed.
    """
    body = tracks.bodies[run.body]
    if body.geometry is None or body.density is None or run.placement is None:
        raise InputError(f"{tracks.path}: body {body.name} needs a geometry, and a density or a mass, to be simulated")
    own = fill_geometry(body.geometry, particle_spacing)
    spacing = grid_spacing(body.geometry.volume, len(own), config)
    placement = run.placement
    if tracks.ground is None:
        axes = _along_body(placement.rotation, tracks.up)
    else:
        axes = SimulationFrame.from_scene(tracks.up, tracks.ground)
    normals, heights = np.zeros((0, 3)), np.zeros(0)
    if body.clamp is not None:
        in_world = body.clamp.normals @ placement.rotation.T
        heights = body.clamp.heights + in_world @ placement.translation
        normals = axes.vectors_to_simulation(in_world)
        heights = heights + normals @ axes.translation
    if tracks.ground is None:
        axes, heights = _on_nodes(axes, placement.to_world(own), normals, heights, spacing)
    particles = axes.points_to_simulation(placement.to_world(own))
    held = body.clamp.markers if body.clamp is not None else ()
    free = tuple(m for m, name in enumerate(run.markers) if name not in held and np.isfinite(run.at_rest[m]).all())
    if not free:
        raise InputError(f"run {run.name}: no marker with all three axes moves with the material")
    attachment = attach(particles, axes.points_to_simulation(run.at_rest[list(free)]), particle_spacing)
    low, high = particles.min(0), particles.max(0)
    return MarkedBody(
        particles=torch.as_tensor(particles),
        volume=body.geometry.volume,
        density=body.density,
        size=float((high - low).max()),
        axes=axes,
        gravity=axes.vectors_to_simulation(tracks.gravity),
        config=config,
        speed=speed,
        normals=torch.as_tensor(normals),
        heights=torch.as_tensor(heights),
        max_substeps=256,
        contact=contact if tracks.ground is not None else "none",
        attachment=attachment,
        markers=free,
    )


def _along_body(rotation: np.ndarray, up: np.ndarray) -> SimulationFrame:
    """Axes along those of the body, the one nearest to ``up`` as y."""
    to_own = rotation.T
    best, nearest = np.eye(3), -math.inf
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs) @ np.eye(3)[list(order)] @ to_own
            score = float((turn @ up)[1]) + TILT_WEIGHT * float(np.trace(turn))
            if np.linalg.det(turn) > 0 and score > nearest:
                best, nearest = turn, score
    return SimulationFrame(best, np.zeros(3))


def _on_nodes(
    axes: SimulationFrame, world: np.ndarray, normals: np.ndarray, heights: np.ndarray, spacing: float
) -> tuple[SimulationFrame, np.ndarray]:
    """Shift ``axes`` so that nodes lie in the first plane of the clamp, and in the body's middle otherwise."""
    points = axes.points_to_simulation(world)
    shift = -0.5 * (points.max(0) + points.min(0))
    if len(heights):
        along = int(np.abs(normals[0]).argmax())
        if abs(normals[0, along]) > 1 - 1e-6:
            shift[along] = -heights[0] * np.sign(normals[0, along])
    return SimulationFrame(axes.rotation, axes.translation + shift), heights + normals @ shift
