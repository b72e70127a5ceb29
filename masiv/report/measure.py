"""The numbers of a run and of its evaluation, each with its unit, frames and views."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from masiv import metrics
from masiv.errors import InputError
from masiv.files import read_npy
from masiv.scene.scene import Ground, Scene
from masiv.simulation.subdivide import merge_subparticles
from masiv.splat.gaussians import Gaussians

MIN_TRUE_PARTICLES = 8
"""As many as the neighbours from which a true displacement is interpolated."""
_OTHER_SIZE = 5.0
"""Ratio of sizes from which on two bodies are not one: a reconstruction is within tens of per cent, and the next unit
of length is a factor of ten away."""
UNITS = {
    "psnr_db": "dB, whole picture, object on black",
    "psnr_box_db": "dB, box of the observed mask, object on black",
    "psnr_box_in_scene_db": "dB, box of the observed mask, object before the view's own empty background",
    "ssim": "1, whole picture",
    "ssim_box": "1, box of the observed mask",
    "mask_iou": "1",
    "trajectory_rmse_mm": "mm, root mean square over particles and frames",
    "chamfer_1e3mm2": "10³ mm², squared, mean, both directions summed",
    "chamfer_floor_1e3mm2": "10³ mm², two random samplings of the same truth",
    "tracked_error_mm": "mm, mean distance to the true displacement",
    "seconds": "s",
}


def cloud_numbers(
    scene: Scene, gaussians_at: Callable[[int], Gaussians], frames: Sequence[int]
) -> dict[str, Any] | None:
    """Chamfer distance of the Gaussians, which are points of the first cloud, to the cloud of each of ``frames``; None
    without a frame."""
    if not frames:
        return None
    found = []
    for frame in frames:
        means = gaussians_at(frame).means.detach().double().numpy()
        found.append(metrics.chamfer_1e3mm2(means, scene.cloud(frame).points, max(len(means), 8192)))
    return {
        "views": [],
        "frames": list(frames),
        "chamfer_1e3mm2": float(np.mean(found)),
        "chamfer_1e3mm2_by_frame": found,
    }


def agreement(rollout: np.ndarray, trajectory: np.ndarray) -> dict[str, Any]:
    """RMSE [mm] between the twin's particles (T, Q parts, 3) and the estimated ones (T, Q, 3), over frames 1…T−1.

    Raises InputError where the former are not parts of the latter.
    """
    frames = min(len(rollout), len(trajectory))
    simulated = merge_subparticles(rollout[:frames].astype(np.float64), trajectory.shape[1])
    squared = ((simulated - trajectory[:frames]) ** 2).sum(-1).mean(-1)
    return {
        "frames": list(range(1, frames)),
        "trajectory_rmse_mm": float(1e3 * np.sqrt(squared[1:].mean())),
        "trajectory_rmse_mm_by_frame": (1e3 * np.sqrt(squared)).tolist(),
    }


def read_truth(folder: Path, frames: int) -> np.ndarray:
    """``folder``/particles_F.npy (P, 3) [m] for F = 0…, at most ``frames`` of them -> (T, P, 3). Raises InputError."""
    paths = [folder / f"particles_{frame}.npy" for frame in range(frames)]
    present = [path.is_file() for path in paths]
    if not present[0]:
        raise InputError(
            f"{folder} has no particles_0.npy: give the folder with particles_F.npy, one (P, 3) array a frame"
        )
    count = max(frame for frame in range(frames) if present[frame]) + 1
    if not all(present[:count]):
        raise InputError(f"{paths[present.index(False)]} is missing: the truth needs every frame up to its last one")
    if count < frames:
        warnings.warn(f"{folder} ends at frame {count - 1} of {frames - 1}: later ones are not evaluated", stacklevel=2)
    positions: list[np.ndarray] = []
    for path in paths[:count]:
        points = read_npy(path)
        if points.ndim != 2 or points.shape[1] != 3 or (positions and points.shape != positions[0].shape):
            raise InputError(f"{path} has shape {points.shape}: every frame needs the same particles, (P, 3)")
        if len(points) < MIN_TRUE_PARTICLES:
            raise InputError(f"{path} has {len(points)} particles: a shape needs {MIN_TRUE_PARTICLES} or more")
        if not np.isfinite(points).all():
            raise InputError(f"{path} has a position that is not finite")
        positions.append(points)
    return np.stack(positions)


def require_same_body(truth: np.ndarray, rest: np.ndarray, folder: Path) -> None:
    """Raises InputError if the boxes around the ``truth`` (P, 3) and the reconstruction ``rest`` (Q, 3) [m] at frame 0
    do not even overlap, or differ much in size: then one is of another scene or has another unit."""
    ratio = float(np.ptp(truth, axis=0).max() / np.ptp(rest, axis=0).max())
    if (
        (truth.min(0) > rest.max(0)).any()
        or (truth.max(0) < rest.min(0)).any()
        or not 1 / _OTHER_SIZE < ratio < _OTHER_SIZE
    ):
        raise InputError(
            f"{folder} is not of this scene: at frame 0 the true body is from {_point(truth.min(0))} to "
            f"{_point(truth.max(0))} m, the reconstructed one from {_point(rest.min(0))} to {_point(rest.max(0))} m"
        )


def _point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"


def motion_numbers(
    motion: np.ndarray, truth: np.ndarray, frames: Sequence[int], *, max_points: int = 8192, seed: int = 0
) -> dict[str, Any] | None:
    """Chamfer and tracked error of ``motion`` (T, Q, 3) over ``frames``; frame 0, where tracking is exact, is left out
    of the latter. None where neither has such frames."""
    frames = [frame for frame in frames if frame < min(len(motion), len(truth))]
    if not frames:
        return None
    chamfer = [metrics.chamfer_1e3mm2(motion[f], truth[f], max_points, seed) for f in frames]
    known = min(len(motion), len(truth))
    tracked = metrics.tracked_error_mm(motion[0], motion[:known], truth[:known])
    moving = [frame for frame in frames if frame > 0]
    return {
        "frames": frames,
        "chamfer_1e3mm2": float(np.mean(chamfer)),
        "tracked_error_mm": float(tracked[moving].mean()) if moving else None,
        "chamfer_1e3mm2_by_frame": chamfer,
        "tracked_error_mm_by_frame": tracked[frames].tolist(),
    }


def baselines(
    rest: np.ndarray,
    velocity: np.ndarray,
    omega: np.ndarray,
    gravity: np.ndarray,
    times: np.ndarray,
    ground: Ground | None,
) -> dict[str, np.ndarray]:
    """Motions (T, Q, 3) [m] that know no material: rigid free flight, and the same stopping at the ground."""
    centre = rest.mean(axis=0)
    flights = {"rigid free flight": metrics.rigid_ballistic(rest, velocity, omega, centre, gravity, times)}
    if ground is not None:
        stopped = metrics.rigid_ballistic(rest, velocity, omega, centre, gravity, times, ground)
        flights["rigid, stops at the ground"] = stopped
    return flights


def initial_motion(positions: np.ndarray, times: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (3,) [m/s] of the centroid and spin (3,) [rad/s] of a rigid body that best explain the first step.

    The mean acceleration of the step is taken to be ``gravity``. Spin from the Kabsch rotation between frames 0 and 1.
    """
    from scipy.spatial.transform import Rotation

    step = float(times[1] - times[0])
    before, after = positions[0].astype(np.float64), positions[1].astype(np.float64)
    velocity = (after.mean(0) - before.mean(0)) / step - 0.5 * gravity * step
    rotation = Rotation.align_vectors(after - after.mean(0), before - before.mean(0))[0]
    return velocity, rotation.as_rotvec() / step
