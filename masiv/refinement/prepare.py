"""From a recording to its forward model."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.continuum.camera_split import CameraSplit
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.objective import Objective
from masiv.models.filmed_body import FilmedBody
from masiv.models.free_body import FreeBodySetup
from masiv.models.initial_state import InitialMotion, InitialState, estimate_initial_motion
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.mpm.simulator import SUBSTEPS_UNIT
from masiv.observations.motion import Observed
from masiv.observations.noise_floor import noise_floor
from masiv.observations.video import VideoObservation
from masiv.refinement.config import RefineConfig
from masiv.rigid import beyond_rigid
from masiv.scene.scene import Scene
from masiv.subsample import kd_tree_subset

MIN_PARTICLES_PER_CELL = 2.0
MIN_NOISE = 1e-6
"""[m], about what single precision leaves of a position."""
FINER_PARTICLES_PER_CELL = (1.0, 0.5)
"""Of the twin's, on the grids that show what another grid may change. If a body bounces, finer grids do not come nearer
to each other: each is one draw of that error."""
SPARE_SUBSTEPS = 1.25
"""More particles may be faster, too."""


def prepare(
    name: str,
    scene: Scene,
    fitted: Observed,
    whole: Observed,
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
    *,
    camera_split: CameraSplit | None = None,
) -> tuple[FreeBodySetup, Objective, Objective, InitialMotion]:
    """What ``FreeBodyModel`` needs of a recording; objectives of its fitted frames alone, on the same particles and on
    fewer; the estimate of the initial motion.

    fitted: the motion of the frames that may be fitted. whole: of all frames; only the later ones are taken from it.
    camera_split: points were followed no better than it says; without it, what ``config.tracking_error`` says counts
    alone.
    """
    count, samples = fitted.positions.shape[1], config.samples_per_frame
    on_coarse, on_coarser = (
        thinned(simulator, min(n / count, 1.0)) for n in (config.particles, config.search_particles)
    )
    chosen, fewest = (kd_tree_subset(fitted.positions[0], n) for n in (config.particles, config.search_particles))
    coarse = FilmedBody(scene, fitted, on_coarse, samples=samples, chosen=chosen)
    coarser = FilmedBody(scene, fitted, on_coarser, samples=samples, chosen=fewest)
    # Rollouts on finer grids need no adjoint: no state is kept beyond the few that the kernels work on.
    finer = tuple(
        FilmedBody(
            scene,
            whole,
            finer_than(coarse, count, thinned(simulator, part)),
            samples=samples,
            max_substeps=SUBSTEPS_UNIT,
        )
        for part in FINER_PARTICLES_PER_CELL
    )
    body = FilmedBody(scene, whole, on_coarse, samples=samples, chosen=chosen).with_first_targets(coarse)
    motion = estimate_initial_motion(
        fitted.positions, fitted.times, scene.gravity, scene.ground, clearance=coarse.spacing
    )
    noise = max(noise_floor(fitted.positions, motion.last_frame), MIN_NOISE)
    times = np.arange(1, len(body.targets) + 1) / (samples * scene.fps)
    lost, tracking_error = np.zeros(len(times)), None
    if scene.cameras or scene.load_cloud:
        positions = torch.cat([body.particles[None], body.targets]).double().numpy()
        lost = config.tracking_error * beyond_rigid(positions)
    if camera_split is not None:
        in_world = camera_split.tracking_error(fitted.positions[0][chosen], times)
        tracking_error = body.axes.vectors_to_simulation(in_world)
        lost = np.maximum(lost, np.sqrt((tracking_error**2).sum(2).mean(1)))
    observation = VideoObservation(
        name=name,
        times=times,
        points=body.particles.double().numpy(),
        values=body.targets.numpy(),
        fit_count=(len(fitted.times) - 1) * samples,
        test_count=math.floor(config.test_fraction * (len(whole.times) - len(fitted.times))) * samples,
        noise_std=noise,
        residual_std=np.hypot(noise, np.maximum.accumulate(lost)),
        tracking_error=tracking_error,
        samples_per_frame=samples,
        simulation_axes=body.axes,
    )
    start = InitialState.of_world(coarse.axes, motion.velocity, motion.omega)
    paths = identify.model_copy(update={"samples_per_frame": samples})
    objective = Objective(coarse, paths)
    setup = FreeBodySetup(observation, body, finer, start, motion.last_frame, objective.ground_range)
    return setup, objective, Objective(coarser, paths), motion


def finer_than(coarse: FilmedBody, count: int, simulator: SimulatorConfig) -> SimulatorConfig:
    """``simulator`` for ``count`` particles of the body of ``coarse``, with as many more substeps as its finer grid
    may ask for, in proportion for sound and to the square for a viscosity: what can be simulated there can be here."""
    ratio = coarse.spacing / grid_spacing(coarse.volume, count, simulator)
    most = math.ceil(SPARE_SUBSTEPS * max(ratio, 1.0) ** 2 * coarse.body.config.max_substeps_per_frame)
    return simulator.model_copy(update={"max_substeps_per_frame": most})


def thinned(simulator: SimulatorConfig, part: float) -> SimulatorConfig:
    """``simulator`` for a ``part`` of the particles on the same grid, as far as its cells stay filled."""
    per_cell = max(simulator.particles_per_cell * part, min(MIN_PARTICLES_PER_CELL, simulator.particles_per_cell))
    return simulator.model_copy(update={"particles_per_cell": per_cell})
