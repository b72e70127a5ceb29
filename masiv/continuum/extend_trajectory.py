"""Continue a finished trajectory through frames that it was not fitted to."""

from __future__ import annotations

import copy
import math

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import FilledVolume, fill_later_frame, hull_volume
from masiv.continuum.finetune import KnownMotion, fine_tune
from masiv.continuum.trajectory import Trajectory, positions_at
from masiv.errors import InputError, MasivError
from masiv.hull.velocity import with_velocities
from masiv.hull.volume import VolumePrior
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians

_STEPS, _POINTS, _LEARNING_RATE = 300, 400, 3e-3
"""Of the fit that initializes the network before fine-tuning."""


def extend_trajectory(
    scene: Scene,
    dynamic: DynamicGaussians,
    trajectory: Trajectory,
    config: TrajectoryConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Trajectory:
    """``trajectory``, of the first N frames of ``scene``, extended to all frames.

    dynamic: Gaussians with a motion over all frames, as ``extend_frames`` gives it. positions[:N] of the result equal
    those given. Its network only approximates them, so use ``evaluate`` for times from frame N on.
    Raises InputError if ``scene`` has no further frame, MasivError if a new frame has no volume to fill or the motion
    becomes non-finite.
    """
    known = len(trajectory.positions)
    motion = dynamic.deformation
    if not known < scene.frame_count == motion.frame_count:
        raise InputError(
            f"{scene.path} has {scene.frame_count} frames, the extended motion {motion.frame_count} and the trajectory "
            f"{known}: give the scene and the motion of the same frames, more than the trajectory has"
        )
    scene = with_velocities(scene, dynamic.base_positions(scene.times))
    start = FilledVolume(trajectory.positions[0].astype(np.float64), trajectory.spacing, trajectory.volume)
    hull = hull_volume(scene, config)
    same = None
    if math.isfinite(trajectory.volume_log_sd):
        same = VolumePrior(trajectory.volume, trajectory.volume_log_sd)
    volumes = []
    for frame in range(known, scene.frame_count):
        progress("fill new frames", frame - known + 1, scene.frame_count - known)
        volumes.append(fill_later_frame(scene, dynamic, frame, config, start, hull, same))
    known_motion = KnownMotion(
        torch.from_numpy(trajectory.positions - trajectory.positions[0]),
        _initial_network(motion, dynamic.canonical.means.detach(), trajectory, seed),
    )
    network = fine_tune(
        scene,
        dynamic,
        start,
        volumes,
        config,
        seed=seed,
        checkpoint=checkpoint or Checkpoint(None),
        progress=progress,
        known=known_motion,
    )
    new = positions_at(network, trajectory.positions[0], scene.times[known:])
    if not np.isfinite(new).all():
        raise MasivError("the motion of the new frames became non-finite; lower trajectory.learning_rate")
    positions = np.concatenate([trajectory.positions, new])
    return Trajectory(positions, scene.times, trajectory.spacing, trajectory.volume, network)


def _initial_network(
    motion: DeformationNetwork, surface: torch.Tensor, trajectory: Trajectory, seed: int
) -> DeformationNetwork:
    """A copy of ``motion``, fitted to the known frames of ``trajectory`` and to ``motion`` after them.

    surface: Gaussians (N, 3) [m] at frame 0. The offset between trajectory and ``motion`` at the last known frame is
    added to all later frames. Without it the particles would jump between the last known and the first new frame.
    """
    known = len(trajectory.positions)
    points = torch.cat([torch.from_numpy(trajectory.positions[0]), surface.float()])
    times = torch.arange(motion.frame_count) / motion.fps
    with torch.no_grad():
        target = motion.displacements(points, times)
        given = trajectory.network.displacements(points, times[:known])
        target[known:] += given[-1] - target[known - 1]
        target[:known] = given
    network = copy.deepcopy(motion).requires_grad_(True)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.0)
    extent = motion.settings["half_extent"]
    for step in range(_STEPS):
        rng = np.random.default_rng((seed, 1, step))
        chosen = torch.from_numpy(rng.permutation(len(points))[:_POINTS])
        for group in optimiser.param_groups:
            group["lr"] = _LEARNING_RATE * (0.01 + 0.495 * (1 + math.cos(math.pi * step / _STEPS)))
        optimiser.zero_grad()
        off = network.displacements(points[chosen], times) - target[:, chosen]
        (off.square().sum(-1).mean() / extent**2).backward()
        optimiser.step()
    return network.requires_grad_(False)
