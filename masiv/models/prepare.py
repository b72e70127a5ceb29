"""From a scene and its observed motion to an experiment."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.identify.config import IdentifyConfig
from masiv.models.free_body import VideoObservation
from masiv.models.initial_state import InitialMotion, InitialState, estimate_initial_motion
from masiv.models.problem import Problem
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.observations.motion import Observed
from masiv.observations.noise_floor import noise_floor
from masiv.refine.config import RefineConfig
from masiv.rigid import beyond_rigid
from masiv.scene.scene import Scene
from masiv.subsample import kd_tree_subset

LEAST_PER_CELL = 2.0
LEAST_NOISE = 1e-6
"""[m], about what single precision leaves of a position."""
FINER = (1.0, 0.5)
"""Particles per cell, of the twin's, on the grids that say what another grid may change. Where a body bounces they do
not come nearer to each other as they get finer, so that one of them is one draw of that error."""

TO_SPARE = 1.25
"""More particles than few may be faster, too."""


def video_observation(
    name: str,
    scene: Scene,
    fitted: Observed,
    whole: Observed,
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
) -> tuple[VideoObservation, Problem, Problem, InitialMotion]:
    """The experiment, the problem of its fitted frames alone (on the same particles), that on few particles, and the
    launch.

    fitted: the motion over the frames that may be fitted. whole: over all frames; only those after are taken from it.
    """
    settings = identify.model_copy(update={"samples_per_frame": config.samples_per_frame})
    count = fitted.positions.shape[1]
    on_few, on_fewer = (thinned(simulator, min(n / count, 1.0)) for n in (config.particles, config.search_particles))
    chosen, fewest = (kd_tree_subset(fitted.positions[0], n) for n in (config.particles, config.search_particles))
    coarse = Problem(scene, fitted, settings, on_few, chosen=chosen)
    coarser = Problem(scene, fitted, settings, on_fewer, chosen=fewest)
    finer = tuple(
        Problem(scene, whole, settings, finer_than(coarse, count, thinned(simulator, share))) for share in FINER
    )
    problem = Problem(scene, whole, settings, on_few, chosen=chosen)
    problem.targets[: len(coarse.targets)] = coarse.targets
    problem.start = coarse.start
    initial_motion = estimate_initial_motion(
        fitted.positions, fitted.times, scene.gravity, scene.ground, clearance=coarse.spacing
    )
    motion = InitialState.of_world(coarse.axes, initial_motion.velocity, initial_motion.omega)
    noise = max(noise_floor(fitted.positions, initial_motion.last_frame), LEAST_NOISE)
    seen = torch.cat([problem.start[None], problem.targets]).double().numpy()
    lost = config.tracking_error * beyond_rigid(seen) if scene.cameras else np.zeros(len(problem.targets))
    residual_std = np.hypot(noise, np.maximum.accumulate(lost))
    return (
        VideoObservation(
            name, problem, len(fitted.times), motion, initial_motion.last_frame, finer, noise, residual_std
        ),
        coarse,
        coarser,
        initial_motion,
    )


def finer_than(coarse: Problem, count: int, simulator: SimulatorConfig) -> SimulatorConfig:
    """``simulator`` for ``count`` particles of the body of ``coarse``, with as many more substeps for a law as its
    finer grid asks for: a law that can be simulated there can be here."""
    ratio = coarse.spacing / grid_spacing(coarse.volume, count, simulator)
    most = math.ceil(TO_SPARE * max(ratio, 1.0) * coarse.simulator.max_substeps_per_frame)
    return simulator.model_copy(update={"max_substeps_per_frame": most})


def thinned(simulator: SimulatorConfig, share: float) -> SimulatorConfig:
    """``simulator`` for a ``share`` of the particles on the same grid, as far as its cells stay filled."""
    per_cell = max(simulator.particles_per_cell * share, min(LEAST_PER_CELL, simulator.particles_per_cell))
    return simulator.model_copy(update={"particles_per_cell": per_cell})
