"""Rollouts of a free body at the frames of a video."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.context import EffectContext
from masiv.effects.effect import Effect
from masiv.materials.law import Law
from masiv.models.deformable import DeformableBody, HeldSubsteps, halved
from masiv.models.initial_state import InitialState, rigid_initial_state
from masiv.mpm.config import SimulatorConfig
from masiv.observations.motion import Observed
from masiv.scene.scene import Scene
from masiv.scene.transforms import SimulationFrame

REST_CELLS = 0.1
"""A body is at rest if its particles are, on average, this close to their mean places from then on [grid cells].
Chosen: a grid does not resolve movements that are so small."""
OUTERMOST = 0.9
"""Quantile of the particles' distances from their middle that is half of the body's size."""


class FilmedBody:
    """Particles of an observed motion, simulated at ``samples`` instants a frame.

    body: the particles at frame 0, float32, simulation axes. targets (F * samples, N, 3) [m, simulation axes]: where
    they were observed at these instants, the start left out. known: effects, with their parameters (P,), that act in
    every rollout that is given none.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Observed,
        simulator: SimulatorConfig,
        *,
        samples: int = 1,
        chosen: np.ndarray | None = None,
        known: Sequence[tuple[Effect, torch.Tensor]] = (),
        max_substeps: int = DeformableBody.max_substeps,
    ) -> None:
        """chosen (N,): which particles of the motion are simulated; None: all. max_substeps: see ``DeformableBody``."""
        self.scene = scene
        self.samples = samples
        self.frames = len(motion.times) - 1
        self.axes = SimulationFrame.from_scene(scene.up, scene.ground)
        instants = np.arange(1, self.frames * samples + 1) / (samples * scene.fps)
        points = motion.evaluate(np.concatenate([[0.0], instants]))
        self.chosen = np.arange(points.shape[1]) if chosen is None else chosen
        moved = torch.as_tensor(self.axes.points_to_simulation(points[:, self.chosen]), dtype=torch.float32)
        start, self.targets = moved[0].contiguous(), moved[1:]
        span = torch.cat([start[None], moved])
        self.body = DeformableBody(
            particles=start,
            volume=motion.volume,
            density=scene.density,
            size=float((start - start.mean(0)).norm(dim=1).quantile(OUTERMOST)) * 2,
            axes=self.axes,
            gravity=self.axes.vectors_to_simulation(scene.gravity),
            config=simulator,
            speed=float((span[1:] - span[:-1]).norm(dim=2).max()) * samples * scene.fps,
            max_substeps=max_substeps,
        )
        self.known = tuple(known)

    def with_first_targets(self, other: FilmedBody) -> FilmedBody:
        """A copy that starts where ``other``, with the same particles, does, and has its targets as far as they go."""
        out = copy.copy(self)
        out.targets = torch.cat([other.targets, self.targets[len(other.targets) :]])
        out.body = replace(self.body, particles=other.particles)
        return out

    @property
    def particles(self) -> torch.Tensor:
        """At frame 0 (N, 3) [m, simulation axes]."""
        return self.body.particles

    @property
    def count(self) -> int:
        """N"""
        return self.body.count

    @property
    def volume(self) -> float:
        """[m³]"""
        return self.body.volume

    @property
    def size(self) -> float:
        """[m]"""
        return self.body.size

    @property
    def spacing(self) -> float:
        """Of the grid [m]."""
        return self.body.spacing

    @property
    def moving_frames(self) -> int:
        """Frames until the observed body is at rest for good; all ``frames`` if it still moves in the last one."""
        remaining = torch.arange(len(self.targets), 0, -1)[:, None, None]
        mean_from_then = self.targets.flip(0).cumsum(0).flip(0) / remaining
        distance = (self.targets - mean_from_then).norm(dim=2).mean(1)
        moving = torch.nonzero(distance > REST_CELLS * self.spacing)
        return min(-(-(int(moving.max()) + 2) // self.samples), self.frames) if len(moving) > 0 else self.frames

    def substeps(self, law: Law, effects: ActiveEffects | None = None) -> int:
        """Substeps in a frame for ``law`` with ``effects`` (``known`` if None); a multiple of 8, so that a law that
        changes a little keeps its number. Raises MasivError if those are too many."""
        unit = 8 * self.samples
        return -(-self.min_substeps(law, effects) // unit) * unit

    def min_substeps(self, law: Law, effects: ActiveEffects | None = None) -> int:
        """The fewest substeps in a frame that ``law`` with ``effects`` (``known`` if None) is stable with. Raises
        MasivError if those are too many."""
        return self.body.substeps(law, 1 / self.scene.fps, self._acting(effects))

    def held_substeps(self, law: Law, held: HeldSubsteps, key: Hashable) -> int:
        """Substeps in a frame to take for ``law`` and what is ``known``: as many as ``held`` has for ``key``. Raises
        NonFiniteError if those are too few, and MasivError if the law needs too many."""
        first, needed = (1 / (self.scene.fps * n) for n in (self.substeps(law), self.min_substeps(law)))
        return round(1 / (self.scene.fps * held.take(key, needed, first)))

    def substeps_with(self, held: int, law: Law, effects: ActiveEffects) -> int:
        """Substeps in a frame for ``law`` with ``effects``, where the law alone takes ``held``; see ``halved``. Raises
        MasivError if those are too many."""
        unit, most = 8 * self.samples, self.body.config.max_substeps_per_frame
        asked = self.min_substeps(law, effects)
        return round(1 / halved(1 / held, 1 / asked, 1 / (-(-most // unit) * unit)))

    def _acting(self, effects: ActiveEffects | None) -> ActiveEffects | None:
        return self.body.effects(self.known, self.context()) if effects is None and self.known else effects

    def context(self, fit_frames: int | None = None) -> EffectContext:
        """What effects may know of the recording, of its motion the first ``fit_frames`` frames after frame 0."""
        path = torch.cat([self.particles[None], self.targets[self.samples - 1 :: self.samples]])
        if fit_frames is not None:
            path = path[: fit_frames + 1]
        return self.body.context(self.frames / self.scene.fps, 1 / self.scene.fps, path)

    def run(
        self,
        law: Law,
        start: InitialState,
        contact: str,
        frames: int,
        steps: int | None = None,
        effects: ActiveEffects | None = None,
    ) -> torch.Tensor:
        """Positions (frames * samples, N, 3) [m, simulation axes of the scene], differentiable.

        steps: substeps a frame, a multiple of ``samples``; as many as the law needs if None. effects: ``known`` if
        None. Raises NonFiniteError, and MasivError if the law needs too many substeps.
        """
        effects = self._acting(effects)
        steps = steps or self.substeps(law, effects)
        # The ground is the plane y = 0 of the simulation: to raise it, the body is lowered.
        raised = start.ground_offset + (effects.ground_shift() if effects else 0.0)
        shift = torch.stack([torch.zeros(()), raised, torch.zeros(())])
        state = rigid_initial_state(self.particles - shift, start.velocity, start.omega)
        every = steps // self.samples
        instants = torch.arange(every, frames * steps + 1, every)
        delay = effects.time_shift() * self.scene.fps * steps if effects else torch.zeros(())
        without_delay = float(delay) == 0.0 and not delay.requires_grad
        whole = int(torch.floor(delay))
        before = (instants + whole).clamp_min(0)
        outputs = instants if without_delay else torch.unique(torch.cat([before, before + 1]))
        positions = self.body.rollout(
            law, state, outputs.tolist(), substep=1 / (self.scene.fps * steps),
            contact="none" if self.scene.ground is None else contact, effects=effects,
        )  # fmt: skip
        if without_delay:
            return positions + shift
        # Between two substeps a particle moves in a straight line.
        early, after = (positions[torch.searchsorted(outputs, k)] for k in (before, before + 1))
        return early + (delay - whole) * (after - early) + shift
