"""The identify stage: trajectory -> launch -> start -> joint fit -> twin."""

from __future__ import annotations

import numpy as np
import torch

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.continuum.trajectory import Trajectory
from masiv.identify.config import IdentifyConfig
from masiv.identify.fit import fit
from masiv.identify.launch import estimate_launch
from masiv.identify.problem import Motion, Problem
from masiv.identify.start import Start, choose_start
from masiv.materials.neural import NeuralLaw
from masiv.mpm.config import SimulatorConfig
from masiv.progress import Progress, silent
from masiv.scene.scene import Ground, Scene
from masiv.twin import Twin


def identify(
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Twin:
    """The twin of what ``trajectory`` (over the frames of ``scene``) shows. Raises MasivError where no law explains it.

    Nothing is assumed of the material: the pretrained law whose rollout is nearest to the motion is only the start.
    """
    with runtime.torch_threads(1):
        return _identify(scene, trajectory, config, simulator, seed, checkpoint or Checkpoint(None), progress)


def _identify(
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Twin:
    problem = Problem(scene, trajectory, config, simulator)
    launch = estimate_launch(
        trajectory.positions, trajectory.times, scene.gravity, scene.ground, clearance=problem.spacing
    )
    axes = problem.axes
    motion = Motion(
        torch.as_tensor(axes.vectors_to_simulation(launch.velocity), dtype=torch.float32),
        torch.as_tensor(axes.vectors_to_simulation(launch.omega), dtype=torch.float32),
        torch.zeros(()),
    )
    saved = checkpoint.load() or {}
    if "start" in saved:
        start = _start_from(saved["start"])
    else:
        few = Problem(scene, trajectory, config, simulator, particles=config.search_particles, seed=seed)
        start = choose_start(few, motion, progress)[0]
    keeper = _With(checkpoint, {"start": _start_state(start)})
    keeper.save({**saved})
    found = fit(
        problem, start.law, motion, start.contact, min(launch.last_frame + 2, problem.frames),
        seed=seed, checkpoint=keeper, progress=progress,
    )  # fmt: skip
    ground = scene.ground
    if ground is not None:
        ground = Ground(ground.normal, ground.height + float(found.motion.ground_offset))
    return Twin(
        positions=np.asarray(trajectory.positions[0], dtype=np.float32),
        velocity=axes.vectors_to_world(found.motion.velocity.double().numpy()),
        omega=axes.vectors_to_world(found.motion.omega.double().numpy()),
        gravity=np.asarray(scene.gravity, dtype=np.float64),
        ground=ground,
        contact=start.contact,
        friction=0.0,
        volume=trajectory.volume,
        density=scene.density,
        up=np.asarray(scene.up, dtype=np.float64),
        fps=scene.fps,
        law=found.law,
        simulator=simulator,
        fit={
            "start": start.material,
            "start_error_mm": 1e3 * start.error,
            "trajectory_error_mm": 1e3 * found.error_m,
            "launch_velocity_m_per_s": [float(v) for v in launch.velocity],
            "launch_omega_rad_per_s": [float(v) for v in launch.omega],
            "launch_last_frame": launch.last_frame,
            "frames": scene.frame_count,
            "history": [{"iteration": i, "frames": k, "trajectory_error_mm": 1e3 * e, "silhouette": s}
                        for i, k, e, s in found.history],
        },
    )  # fmt: skip


class _With(Checkpoint):
    """A checkpoint whose every state also holds ``fixed``."""

    def __init__(self, checkpoint: Checkpoint, fixed: dict) -> None:
        super().__init__(checkpoint.path, checkpoint.every_s)
        self.fixed = fixed

    def save(self, state: dict) -> None:
        super().save({**state, **self.fixed})


def _start_state(start: Start) -> dict:
    return {
        "material": start.material,
        "contact": start.contact,
        "error": start.error,
        "width": start.law.width,
        "law": start.law.state_dict(),
    }


def _start_from(state: dict) -> Start:
    law = NeuralLaw(width=state["width"])
    law.load_state_dict(state["law"])
    return Start(state["material"], state["contact"], law, state["error"])
