"""From a scene and its observed motion to an experiment."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.identify.config import IdentifyConfig
from masiv.identify.few import well_spread
from masiv.identify.launch import Launch, estimate_launch
from masiv.identify.problem import Motion, Problem
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.refine.config import RefineConfig
from masiv.refine.model import Experiment
from masiv.refine.noise import noise_floor
from masiv.refine.observed import Observed
from masiv.rigid import beyond_rigid
from masiv.scene.scene import Scene

LEAST_PER_CELL = 2.0
LEAST_NOISE = 1e-6
"""[m], about what single precision leaves of a position."""
FINER = (1.0, 0.5)
"""Particles per cell, of the twin's, on the grids that say what another grid may change. Where a body bounces they do
not come nearer to each other as they get finer, so that one of them is one draw of that error."""

TO_SPARE = 1.25
"""More particles than few may be faster, too."""


def experiment_of(
    name: str,
    scene: Scene,
    fitted: Observed,
    whole: Observed,
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
) -> tuple[Experiment, Problem, Problem, Launch]:
    """The experiment, the problem of its fitted frames alone (on the same particles), that on few particles, and the
    launch.

    fitted: the motion over the frames that may be fitted. whole: over all frames; only those after are taken from it.
    """
    settings = identify.model_copy(update={"samples_per_frame": config.samples_per_frame})
    count = fitted.positions.shape[1]
    on_few, on_fewer = (thinned(simulator, min(n / count, 1.0)) for n in (config.particles, config.search_particles))
    chosen, fewest = (well_spread(fitted.positions[0], n) for n in (config.particles, config.search_particles))
    few = Problem(scene, fitted, settings, on_few, chosen=chosen)
    fewer = Problem(scene, fitted, settings, on_fewer, chosen=fewest)
    finer = tuple(Problem(scene, whole, settings, finer_than(few, count, thinned(simulator, share))) for share in FINER)
    problem = Problem(scene, whole, settings, on_few, chosen=chosen)
    problem.targets[: len(few.targets)] = few.targets
    problem.start = few.start
    launch = estimate_launch(fitted.positions, fitted.times, scene.gravity, scene.ground, clearance=few.spacing)
    motion = Motion.of_world(few.axes, launch.velocity, launch.omega)
    noise = max(noise_floor(fitted.positions, launch.last_frame), LEAST_NOISE)
    seen = torch.cat([problem.start[None], problem.targets]).double().numpy()
    lost = config.tracking_error * beyond_rigid(seen) if scene.cameras else np.zeros(len(problem.targets))
    sigma = np.hypot(noise, np.maximum.accumulate(lost))
    return (
        Experiment(name, problem, len(fitted.times), motion, launch.last_frame, finer, noise, sigma),
        few,
        fewer,
        launch,
    )


def finer_than(few: Problem, count: int, simulator: SimulatorConfig) -> SimulatorConfig:
    """``simulator`` for ``count`` particles of the body of ``few``, with as many more substeps for a law as its finer
    grid asks for: a law that can be simulated there can be here."""
    ratio = few.spacing / grid_spacing(few.volume, count, simulator)
    most = math.ceil(TO_SPARE * max(ratio, 1.0) * few.simulator.max_substeps_per_frame)
    return simulator.model_copy(update={"max_substeps_per_frame": most})


def thinned(simulator: SimulatorConfig, share: float) -> SimulatorConfig:
    """``simulator`` for a ``share`` of the particles on the same grid, as far as its cells stay filled."""
    per_cell = max(simulator.particles_per_cell * share, min(LEAST_PER_CELL, simulator.particles_per_cell))
    return simulator.model_copy(update={"particles_per_cell": per_cell})
