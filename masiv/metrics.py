"""Errors of motions and pictures, and the baseline of a rigid body in free flight.

Points are (N, 3) and motions (T, N, 3), in metres; pictures (H, W, 3) uint8, or float in [0, 1];
masks (H, W) in [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from masiv.errors import InputError
from masiv.scene.scene import Ground

SSIM_RADIUS = 5
"""Of the window of the structural similarity [pixels]."""


def chamfer_1e3mm2(a: np.ndarray, b: np.ndarray, max_points: int = 8192, seed: int = 0) -> float:
    """Chamfer distance of two point sets [10³ mm²], as in MASIV: the sum over both directions of the mean squared
    distance to the nearest point.

    At most ``max_points`` of each set are used, drawn with ``seed``. Two points 10 mm apart have the distance 0.2.
    Raises InputError if a set is empty or not finite.
    """
    first, second = (_sampled(_finite(points, "chamfer"), max_points, seed + k) for k, points in enumerate((a, b)))
    forth, _ = cKDTree(second).query(first)
    back, _ = cKDTree(first).query(second)
    return float((forth**2).mean() + (back**2).mean()) * 1e3


def chamfer_floor(truth: np.ndarray, max_points: int = 8192, seed: int = 0) -> float:
    """Chamfer distance [10³ mm²] between two random samplings of one ``truth`` (P, 3): the value of a perfect result.

    Two disjoint halves of the truth are compared. At full density, distances are smaller by a factor of 2^(1/3).
    """
    order = np.random.default_rng(seed).permutation(len(truth))
    half = len(truth) // 2
    halves = chamfer_1e3mm2(truth[order[:half]], truth[order[half : 2 * half]], max_points, seed)
    return halves / 2 ** (2 / 3)


def tracked_error_mm(
    rest_points: np.ndarray, trajectory: np.ndarray, truth: np.ndarray, neighbours: int = 8
) -> np.ndarray:
    """Mean distance (T,) [mm] between the displacements of particles and the true ones, for each frame.

    rest_points (Q, 3): positions of the particles at frame 0; trajectory (T, Q, 3): their motion; truth (T, P, 3). The
    true displacement of a particle is the mean over its ``neighbours`` nearest true particles at frame 0, weighted by
    inverse distance. Raises InputError if shapes do not match or values are not finite.
    """
    if trajectory.shape[0] != truth.shape[0] or trajectory.shape[1:] != rest_points.shape:
        raise InputError(
            f"trajectory {trajectory.shape}, rest points {rest_points.shape}, truth {truth.shape}: no match"
        )
    _finite(trajectory, "trajectory")
    _finite(truth, "truth")
    pairs = zip(trajectory, true_displacements(rest_points, truth, neighbours), strict=True)
    return np.array([1e3 * np.linalg.norm(moved - rest_points - true, axis=1).mean() for moved, true in pairs])


def true_displacements(rest_points: np.ndarray, truth: np.ndarray, neighbours: int = 8) -> Iterator[np.ndarray]:
    """Displacements (Q, 3) [m] of particles at ``rest_points`` (Q, 3) in each frame of ``truth`` (T, P, 3), see
    ``tracked_error_mm``."""
    distance, index = cKDTree(truth[0]).query(rest_points, k=min(neighbours, truth.shape[1]))
    distance, index = distance.reshape(len(rest_points), -1), index.reshape(len(rest_points), -1)
    weight = 1.0 / (distance + 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    for true in truth:
        yield np.einsum("qk,qkd->qd", weight, (true - truth[0]).astype(np.float64)[index])


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB] over all pixels and channels; infinite for equal pictures."""
    box = content_box(image, reference)
    if box is None:
        return float("inf")
    error = float(((_unit(image[box]) - _unit(reference[box])) ** 2).sum()) / image.size
    return float("inf") if error == 0 else -10.0 * float(np.log10(error))


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004): 11×11 Gaussian window, σ = 1.5, zero padding, mean over channels."""
    box = content_box(image, reference, margin=SSIM_RADIUS)
    if box is None:
        return 1.0
    a, b = _unit(image[box]), _unit(reference[box])
    mean_a, mean_b = _window(a), _window(b)
    variance_a, variance_b = _window(a * a) - mean_a**2, _window(b * b) - mean_b**2
    covariance = _window(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    score /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return float((score - 1).sum()) / image.size + 1  # it is 1 where the windows of both are black


def content_box(*pictures: np.ndarray, margin: int = 0) -> tuple[slice, slice] | None:
    """Rows and columns with all pixels that are not black in each of ``pictures`` (H, W, C), and ``margin`` more; None
    if there is none."""
    lit = np.zeros(pictures[0].shape[:2], bool)
    for picture in pictures:
        for channel in range(picture.shape[2]):  # ``any`` over the last axis takes five times as long
            lit |= picture[:, :, channel] != 0
    return _box(lit, margin)


def mask_box(mask: np.ndarray, margin: int = 4) -> tuple[slice, slice] | None:
    """Rows and columns of the mask's bounding box with a margin of ``margin`` pixels; None for an empty mask."""
    return _box(mask > 0.5, margin)


def _box(marked: np.ndarray, margin: int) -> tuple[slice, slice] | None:
    rows, columns = np.flatnonzero(marked.any(axis=1)), np.flatnonzero(marked.any(axis=0))
    if len(rows) == 0:
        return None
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + 1 + margin),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + 1 + margin),
    )


def picture_scores(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """PSNR [dB] and SSIM of the full image, and of the bounding box of ``mask`` if that is not empty."""
    scores = {"psnr_db": psnr(image, reference), "ssim": ssim(image, reference)}
    box = mask_box(mask)
    if box is not None:
        scores |= {"psnr_box_db": psnr(image[box], reference[box]), "ssim_box": ssim(image[box], reference[box])}
    return scores


def mask_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks with threshold 0.5; 1 if both are empty."""
    first, second = a > 0.5, b > 0.5
    union = int((first | second).sum())
    return 1.0 if union == 0 else float((first & second).sum() / union)


def rigid_ballistic(
    positions: np.ndarray,
    velocity: np.ndarray,
    omega: np.ndarray,
    centre: np.ndarray,
    gravity: np.ndarray,
    times: np.ndarray,
    ground: Ground | None = None,
) -> np.ndarray:
    """The motion (T, Q, 3) [m] of a rigid body in free flight: a baseline without material.

    positions (Q, 3) [m] at t = 0, velocity (3,) [m/s] of ``centre`` (3,) [m], omega (3,) [rad/s], gravity (3,) [m/s²],
    times (T,) [s]. With ``ground`` the body stops when its lowest point touches it.
    """
    relative = positions - centre

    def at(time: float) -> np.ndarray:
        moved = centre + velocity * time + 0.5 * gravity * time**2
        return moved + Rotation.from_rotvec(np.asarray(omega) * time).apply(relative)

    limit = np.inf if ground is None else _contact_time(at, ground, float(np.max(times)))
    return np.stack([at(min(float(time), limit)) for time in times])


def _contact_time(at, ground: Ground, end: float) -> float:
    def lowest(time: float) -> float:
        return float((at(time) @ ground.normal).min()) - ground.height

    start = lowest(0.0)
    floor = min(start, 0.0)  # a body that starts below the ground can rise
    grid = np.linspace(0.0, end, 257)
    below = [k for k in range(1, len(grid)) if lowest(grid[k]) < floor - 1e-9]
    if not below:
        return np.inf
    low, high = grid[below[0] - 1], grid[below[0]]
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if lowest(middle) < floor else (middle, high)
    return float(low)


def _sampled(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


def _finite(points: np.ndarray, name: str) -> np.ndarray:
    if len(points) == 0 or not np.isfinite(points).all():
        raise InputError(f"{name}: the points are empty or not finite")
    return points


def _unit(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float64) / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def _window(image: np.ndarray) -> np.ndarray:
    kernel = cv2.getGaussianKernel(2 * SSIM_RADIUS + 1, 1.5)
    return cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
