"""From a scene and its observed motion to an experiment."""

from __future__ import annotations

import torch

from masiv.identify.config import IdentifyConfig
from masiv.identify.launch import Launch, estimate_launch
from masiv.identify.problem import Motion, Problem
from masiv.mpm.config import SimulatorConfig
from masiv.refine.config import RefineConfig
from masiv.refine.model import Experiment
from masiv.refine.observed import Observed
from masiv.scene.scene import Scene


def experiment_of(
    name: str,
    scene: Scene,
    fitted: Observed,
    whole: Observed,
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
    *,
    seed: int,
) -> tuple[Experiment, Problem, Problem, Launch]:
    """The experiment, the problem of its fitted frames alone (on the same particles), that on few particles, and the
    launch.

    fitted: the motion over the frames that may be fitted. whole: over all frames; only those after are taken from it.
    """
    settings = identify.model_copy(update={"samples_per_frame": config.samples_per_frame})
    few = Problem(scene, fitted, settings, simulator, particles=config.particles, seed=seed)
    fewer = Problem(scene, fitted, settings, simulator, particles=config.search_particles, seed=seed)
    fine = Problem(scene, whole, settings, simulator)
    problem = Problem(scene, whole, settings, simulator, particles=config.particles, seed=seed)
    problem.targets[: len(few.targets)] = few.targets
    problem.start = few.start
    launch = estimate_launch(fitted.positions, fitted.times, scene.gravity, scene.ground, clearance=few.spacing)
    motion = Motion(
        torch.as_tensor(few.axes.vectors_to_simulation(launch.velocity), dtype=torch.float32),
        torch.as_tensor(few.axes.vectors_to_simulation(launch.omega), dtype=torch.float32),
        torch.zeros(()),
    )
    return Experiment(name, problem, len(fitted.times), motion, fine), few, fewer, launch
