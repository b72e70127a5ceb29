"""What is fixed while parameters are fitted: observed trajectories, the body, the simulator."""

from __future__ import annotations

import numpy as np
import torch

from masiv.continuum.trajectory import Trajectory
from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.identify.config import IdentifyConfig
from masiv.materials.law import Law
from masiv.models.initial_state import InitialState, rigid_initial_state
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing, substeps_per_frame
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator
from masiv.scene.scene import Scene
from masiv.scene.transforms import SimulationFrame
from masiv.twin import TwinEffect


class Problem:
    """Rollouts of one body against its observed trajectories.

    chosen (N,): which particles of the trajectory are used (all where None). targets (F * samples, N, 3) [m] are their
    positions in the simulation frame at ``samples_per_frame`` instants a frame, the start left out. known: effects that
    act in every rollout which is given none.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        config: IdentifyConfig,
        simulator: SimulatorConfig,
        *,
        chosen: np.ndarray | None = None,
        known: tuple[TwinEffect, ...] = (),
    ) -> None:
        self.scene = scene
        self.config = config
        self.simulator = simulator
        self.axes = SimulationFrame.from_scene(scene.up, scene.ground)
        self.samples = config.samples_per_frame
        self.frames = len(trajectory.times) - 1
        instants = np.arange(1, self.frames * self.samples + 1) / (self.samples * scene.fps)
        points = trajectory.evaluate(np.concatenate([[0.0], instants]))
        self.chosen = np.arange(points.shape[1]) if chosen is None else chosen
        points = points[:, self.chosen]
        moved = torch.as_tensor(self.axes.points_to_simulation(points), dtype=torch.float32)
        self.start, self.targets = moved[0].contiguous(), moved[1:]
        self.count = len(self.start)
        self.volume = trajectory.volume
        self.spacing = grid_spacing(self.volume, self.count, simulator)
        self.gravity = self.axes.vectors_to_simulation(scene.gravity)
        self.size = float((self.start - self.start.mean(0)).norm(dim=1).quantile(0.9)) * 2
        span = torch.cat([self.start[None], moved])
        self.speed = float((span[1:] - span[:-1]).norm(dim=2).max()) * self.samples * scene.fps
        members = tuple((effect_named(e.name), torch.tensor([v for _, v, *_ in e.rows()])) for e in known)
        self.known = ActiveEffects(members, self.setting()) if members else None

    @property
    def ground_range(self) -> float:
        """Greatest offset [m] of the effective ground, 0 if there is no ground."""
        return 0.0 if self.scene.ground is None else self.config.ground_range

    def substeps(self, law: Law) -> int:
        """Substeps in a frame for ``law``; a multiple of 8, so that a law that changes a little keeps its number."""
        unit = 8 * self.samples
        return -(-self.least_substeps(law) // unit) * unit

    def least_substeps(self, law: Law) -> int:
        """The fewest substeps in a frame that ``law`` is stable with. Raises MasivError where those are too many."""
        return substeps_per_frame(
            spacing=self.spacing,
            wave_modulus=law.wave_modulus(),
            density=self.scene.density,
            speed=self.speed,
            frame_time=1 / self.scene.fps,
            config=self.simulator,
        )

    def setting(self) -> EffectContext:
        """What effects may know of the scene."""
        return EffectContext(
            gravity=torch.as_tensor(self.gravity, dtype=torch.float32),
            rest=self.start,
            particle_mass=self.scene.density * self.volume / self.count,
            size=self.size,
            duration=self.frames / self.scene.fps,
            frame_time=1 / self.scene.fps,
            path=torch.cat([self.start[None], self.targets[self.samples - 1 :: self.samples]]),
        )

    def run(
        self,
        law: Law,
        motion: InitialState,
        contact: str,
        frames: int,
        steps: int | None = None,
        effects: ActiveEffects | None = None,
    ) -> torch.Tensor:
        """Positions (frames * samples, N, 3) [m, simulation frame of the scene], differentiable. steps: substeps a
        frame, a multiple of ``samples``; as many as the law needs where None. effects: those that are known where None.
        Raises NonFiniteError."""
        effects = effects or self.known
        steps = steps or self.substeps(law)
        simulator = Simulator(
            particle_count=self.count,
            spacing=self.spacing,
            substep=1 / (self.scene.fps * steps),
            volume=self.volume,
            density=self.scene.density,
            gravity=self.gravity,
            contact=contact if self.scene.ground is not None else "none",
            memory_mb=self.simulator.memory_mb,
            max_substeps=1024,
            grid_nodes=self.simulator.grid_nodes,
            chunks=self.simulator.chunks,
        )
        # The ground is the plane y = 0 of the simulation: raising it is lowering the body.
        raised = motion.ground_offset + (effects.ground_shift() if effects else 0.0)
        shift = torch.stack([torch.zeros(()), raised, torch.zeros(())])
        state = rigid_initial_state(self.start - shift, motion.velocity, motion.omega)
        every = steps // self.samples
        instants = torch.arange(every, frames * steps + 1, every)
        late = effects.time_shift() * self.scene.fps * steps if effects else torch.zeros(())
        if float(late) == 0.0 and not late.requires_grad:
            return rollout(simulator, law, state, frames * steps, instants.tolist(), effects) + shift
        # Between two substeps a particle moves in a straight line.
        whole = int(torch.floor(late))
        before = (instants + whole).clamp_min(0)
        wanted = torch.unique(torch.cat([before, before + 1]))
        positions = rollout(simulator, law, state, int(wanted[-1]), wanted.tolist(), effects)
        early, after = (positions[torch.searchsorted(wanted, k)] for k in (before, before + 1))
        return early + (late - whole) * (after - early) + shift
