"""A measured body in the simulator: particles, clamp, the markers tied to it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.clamp import with_moving_clamp
from masiv.effects.context import EffectContext
from masiv.effects.effect import Effect, HistoryEffect
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.materials.law import Law
from masiv.models.attachment import Attachment, attach
from masiv.models.deformable import DeformableBody, HeldRegion, checked_instants, with_clamps
from masiv.models.release import clamp_axes, static_deflection
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.observations.identity import content_hash
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame
from masiv.tracks.geometry import fill_geometry
from masiv.tracks.placement import Placement
from masiv.tracks.prescribed_motion import PrescribedMotion, Segment, prescribed_motions
from masiv.tracks.tracks import Clamp, Run, Tracks

MAX_SUBSTEPS = 256
"""Of a rollout, whose states are kept at once."""
TILT_WEIGHT = 1e-3
"""Weight of the rotation's trace relative to the height of y: it decides between equal choices of axes."""
SETTLING_SUBSTEPS = 32
"""Between two looks at the kinetic energy of a body that comes to rest …"""
SETTLED = 1e-6
"""… which has come to rest when a peak is below this part of the highest one: the way still to go is a thousandth of
what it sagged …"""
MAX_SETTLING = 2000
"""… and looks after which it never does, as a fluid."""


@dataclass(frozen=True, kw_only=True)
class MarkedBody(DeformableBody):
    """A body that is let go from rest, with markers that are tied to its material.

    contact: with the ground; attachment: of ``markers``, the run's markers that move with the material (indices into
    ``run.markers``). particles: float64. motions: of each clamp, None for one that is fixed; empty if none is carried.
    If one is, the body is at rest in them before.
    """

    contact: str
    attachment: Attachment
    markers: tuple[int, ...]
    motions: tuple[PrescribedMotion | None, ...] = ()

    @cached_property
    def digest(self) -> str:
        """See ``DeformableBody``."""
        own = super().digest
        return content_hash((own, self.motions)) if self.motions else own

    @property
    def carried(self) -> tuple[tuple[HeldRegion, PrescribedMotion], ...]:
        """Clamps that move, and how."""
        both = zip(self.clamps, self.motions, strict=True) if self.motions else ()
        return tuple((clamp, motion) for clamp, motion in both if motion is not None)

    def effects(self, members: Sequence[tuple[Effect, torch.Tensor]], context: EffectContext) -> ActiveEffects:
        """See ``DeformableBody``; without clamps that are carried, which ``pieces`` adds."""
        fixed = [c for k, c in enumerate(self.clamps) if not self.motions or self.motions[k] is None]
        return with_clamps(ActiveEffects(tuple(members), context), fixed)

    @property
    def clamp_axes(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """See ``masiv.models.release.clamp_axes``."""
        return clamp_axes(self.gravity, self.clamps[0].normals) if len(self.clamps) == 1 else None

    def released(self, dtype: torch.dtype = torch.float32, deflection: float = 0.0) -> State:
        """State at the release: at rest. Stress-free if ``deflection`` [m] is 0, else deflected as by its weight."""
        x = self.particles.double()
        gradient = torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)
        axes = self.clamp_axes
        if axes is not None and deflection != 0:
            x, gradient = static_deflection(x, self.clamps[0].heights[0], axes, deflection)
        still = torch.zeros_like(x, dtype=dtype)
        state = at_rest(x.to(dtype), still, torch.zeros_like(gradient, dtype=dtype))
        return replace(state, trial_gradient=gradient.to(dtype).contiguous(), rest_position=self.particles.to(dtype))

    def markers_to_world(self, positions: torch.Tensor) -> np.ndarray:
        """Particles (T, N, 3) [m, simulation axes] -> markers (T, len(markers), 3) [m, world]."""
        return self.axes.points_to_world(self.attachment.apply(positions.detach().double()).numpy())

    def substep(self, law: Law, times: np.ndarray, effects: ActiveEffects | None = None) -> float:
        """The longest [s] that divides the mean interval of ``times`` (T,) [s] evenly and that ``law`` with ``effects``
        is stable with. Raises MasivError if an interval needs too many, InputError for times that do not ascend from
        0."""
        interval = mean_interval(times)
        return interval / self.substeps(law, interval, effects)

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

        effects: see ``effects``; the clamp alone if None. substep [s]: see ``substep``. deflection: see ``released``.
        Raises NonFiniteError, and as ``substep``.
        """
        interval = mean_interval(times)
        effects = effects or self.effects((), self.context(float(times[-1]), interval))
        substep = substep or self.substep(law, times, effects)
        outputs = [round(float(t) / substep) for t in times]
        if not self.carried:
            state = self.released(dtype, deflection)
            positions = self.rollout(law, state, outputs, substep=substep, contact=self.contact, effects=effects)
            return np.array(outputs) * substep, positions
        return np.array(outputs) * substep, self._carried(law, outputs, effects, substep, dtype)

    @torch.no_grad()
    def _carried(
        self, law: Law, outputs: Sequence[int], effects: ActiveEffects, substep: float, dtype: torch.dtype
    ) -> torch.Tensor:
        """Positions (T, N, 3) after each of ``outputs`` substeps, of a body with a clamp that moves."""
        simulator = self.simulator(substep, self.contact, dtype)
        state = self.at_start(simulator, law, effects, dtype)
        found = {0: state.position}
        wanted = sorted(set(outputs))
        for begin, end, acting in self.pieces(effects, 0, wanted[-1], substep):
            own = [step for step in wanted if begin < step <= end]
            try:
                done = simulator.run(state, law, end - begin, [s - begin for s in own], acting, begin * substep)
            except NonFiniteError as error:
                raise NonFiniteError(begin + error.substep, error.particle, error.detail) from error
            found |= dict(zip(own, done.positions, strict=True))
            state = done.final
        return torch.stack([found[step] for step in outputs])

    def at_start(self, simulator: Simulator, law: Law, effects: ActiveEffects, dtype: torch.dtype) -> State:
        """The state at the release: ``released``, or at rest in clamps of which one will be carried."""
        return self._settled(simulator, law, effects, dtype) if self.carried else self.released(dtype)

    def _settled(self, simulator: Simulator, law: Law, effects: ActiveEffects, dtype: torch.dtype) -> State:
        """At rest in the clamps before one moves. By dynamic relaxation with kinetic damping (Cundall 1976): velocities
        become zero whenever the kinetic energy passes a peak. Stresses that relax have done so. Raises MasivError if it
        does not come to rest."""
        lasting = tuple(m for m in effects.members if not isinstance(m[0], HistoryEffect))
        acting = with_clamps(ActiveEffects(lasting, effects.context), [clamp for clamp, _ in self.carried])
        state, before, highest = self.released(dtype), 0.0, 0.0
        for _ in range(MAX_SETTLING):
            # A mass on a thread hangs at rest again.
            state = replace(simulator.run(state, law, SETTLING_SUBSTEPS, [], acting).final, suspended=None)
            energy = float(state.velocity.double().square().sum())
            if energy < before:
                highest = max(highest, before)
                still = torch.zeros_like(state.velocity)
                state = replace(state, velocity=still, affine_velocity=torch.zeros_like(state.affine_velocity))
                if before <= SETTLED * highest or highest == 0:
                    return state
                before = 0.0
            elif energy == 0:
                return state
            else:
                before = energy
        raise MasivError("a body that is carried does not come to rest where it is held: is its law one of a solid?")

    def pieces(
        self, effects: ActiveEffects, begin: int, end: int, substep: float
    ) -> Iterator[tuple[int, int, ActiveEffects]]:
        """Substeps ``begin`` to ``end`` in parts, each with its effects: ``effects``, and the parts of the motions of
        clamps that are carried; none if there is no substep."""
        parts = [
            (clamp, motion, part, round(part.start / substep), round(part.stop / substep))
            for clamp, motion in self.carried
            for part in motion.segments(end * substep)
        ]
        ends = {begin, end, *(s for *_, first, last in parts for s in (first, last) if begin < s < end)}
        for first, last in itertools.pairwise(sorted(ends)):
            acting = effects
            for clamp, motion, part, start, stop in parts:
                if start <= first < stop:
                    acting = self._with_carried(acting, clamp, motion, part)
            yield first, last, acting

    def _with_carried(
        self, effects: ActiveEffects, clamp: HeldRegion, motion: PrescribedMotion, part: Segment
    ) -> ActiveEffects:
        turn, centre = self.axes.rotation, self.axes.points_to_simulation(motion.centre)
        at_rest = self.axes.vectors_to_world(clamp.normals.numpy())
        position = part.position @ turn.T
        position[0] += self.axes.translation
        return with_moving_clamp(
            effects, part.start, torch.as_tensor(position), torch.as_tensor(turn @ part.omega),
            torch.as_tensor(self.axes.vectors_to_simulation(at_rest @ part.rotation.T)),
            clamp.heights - torch.as_tensor(clamp.normals.numpy() @ centre),
        )  # fmt: skip


def mean_interval(times: np.ndarray) -> float:
    """[s] between ``times`` (T,) [s], which begin at the release. Raises InputError unless they ascend from 0."""
    return float(checked_instants(times)[-1]) / max(len(times) - 1, 1)


def marked_body(
    tracks: Tracks,
    run: Run,
    config: SimulatorConfig,
    *,
    particle_spacing: float,
    contact: str = "sticky",
    speed: float = 1.0,
) -> MarkedBody:
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
        clamps=body.clamps,
        at_rest=run.at_rest[list(free)],
        markers=free,
        up=tracks.up,
        gravity=tracks.gravity,
        ground=tracks.ground,
        contact=contact if tracks.ground is not None else "none",
        speed=speed,
        motions=prescribed_motions(run, body.clamps),
    )


def placed_body(
    own: np.ndarray,
    volume: float,
    density: float,
    config: SimulatorConfig,
    *,
    particle_spacing: float,
    placement: Placement,
    clamps: tuple[Clamp, ...],
    at_rest: np.ndarray,
    markers: tuple[int, ...],
    up: np.ndarray,
    gravity: np.ndarray,
    ground: Ground | None,
    contact: str,
    speed: float,
    motions: tuple[PrescribedMotion | None, ...] = (),
) -> MarkedBody:
    """Particles ``own`` (N, 3) [m, own axes], ``particle_spacing`` [m] apart, at a place in the world, and markers tied
    to them that are ``at_rest`` (M, 3) [m, world]. volume [m³]; density [kg/m³]; up (3,) and gravity (3,) [m/s²]:
    world; speed [m/s]: see ``DeformableBody``. motions: see ``MarkedBody``.

    The grid holds ``config.particles_per_cell`` of them a cell. Without a ground it runs along the body's own axes, a
    plane of its nodes in the first plane of the first clamp, which is then not blurred.
    """
    axes = _along_body(placement.rotation, up) if ground is None else SimulationFrame.from_scene(up, ground)
    in_world = [clamp.normals @ placement.rotation.T for clamp in clamps]
    normals = [axes.vectors_to_simulation(n) for n in in_world]
    heights = [clamp.heights + n @ placement.translation for clamp, n in zip(clamps, in_world, strict=True)]
    if ground is None:
        plane = (normals[0][0], heights[0][0] + normals[0][0] @ axes.translation) if clamps else None
        axes = _on_nodes(axes, placement.to_world(own), plane)
    particles = axes.points_to_simulation(placement.to_world(own))
    return MarkedBody(
        particles=torch.as_tensor(particles),
        volume=volume,
        density=density,
        size=float(np.ptp(particles, axis=0).max()),
        axes=axes,
        gravity=axes.vectors_to_simulation(gravity),
        config=config,
        speed=speed,
        clamps=tuple(
            HeldRegion(torch.as_tensor(n), torch.as_tensor(h + n @ axes.translation))
            for n, h in zip(normals, heights, strict=True)
        ),
        max_substeps=MAX_SUBSTEPS,
        contact=contact,
        attachment=attach(particles, axes.points_to_simulation(at_rest), particle_spacing),
        markers=markers,
        motions=motions,
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


def _on_nodes(axes: SimulationFrame, world: np.ndarray, plane: tuple[np.ndarray, float] | None) -> SimulationFrame:
    """Shift ``axes`` so that nodes lie in ``plane``, its normal (3,) and height [m] along it, and in the middle of the
    points ``world`` (N, 3) [m] along other axes."""
    points = axes.points_to_simulation(world)
    shift = -0.5 * (points.max(0) + points.min(0))
    if plane is not None:
        normal, height = plane
        along = int(np.abs(normal).argmax())
        if abs(normal[along]) > 1 - 1e-6:
            shift[along] = -height * np.sign(normal[along])
    return SimulationFrame(axes.rotation, axes.translation + shift)
