"""Cameras corrected by their silhouettes alone, before anything is reconstructed.

Bundle adjustment of the epipolar tangency residuals of all pairs of cameras (``frontier``), with the prior of the
corrections and without their gauge (``gauge``). The residuals have Student's distribution; its scale, its degrees of
freedom and the correlation between frames are estimated from them (EM, Lange, Little and Taylor, "Robust statistical
modeling using the t distribution", JASA 84, 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from masiv.calibration.config import CalibrationPrior
from masiv.calibration.consistency import consistency, pair_errors
from masiv.calibration.frontier import Outlines, TangencyResiduals, tangency_residuals
from masiv.calibration.gauge import (
    POSE,
    camera_precision,
    displacement_jacobian,
    gauge_free_steps,
    prior_deviations,
    scaled_deviations,
)
from masiv.calibration.outline_points import OutlinePoints, outline_points
from masiv.calibration.tangency import Outline, outline
from masiv.scene.calibration import CameraCorrection, corrected_camera
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

MAX_FRAMES = 48
"""Of a long recording, pairs of successive frames are taken, evenly spaced: the motion of outlines needs both."""
MAX_STEPS = 30
CONVERGED_PX = 0.01
"""Steps end when none moves the object by more in any picture; a tangent that jumps between two vertices of an outline
moves it by about as much."""
FINEST_NOISE_PX = 0.01
"""No outline is known better: masks have at most 256 levels, and a pixel of an edge may be curved."""
FEWEST_DEGREES, MOST_DEGREES = 1.0, 30.0
"""Of freedom: from Cauchy's distribution to one that is normal for every purpose here."""


@dataclass(frozen=True)
class SilhouetteFit:
    """Corrections of V cameras, in the order of ``Scene.views``.

    corrections: about ``pivot`` (3,) [m]. points: of the object. standard_errors_px (V,): of the corrections that are
    left without the gauge, as RMS displacement of the object. clock_errors (V,) [s]: standard error of a clock against
    the mean of the others. inconsistency (V,) [pixels]: of the corrected cameras, ``Consistency.pixels``. noise_px:
    scale of the outlines' errors.
    """

    corrections: tuple[CameraCorrection, ...]
    pivot: np.ndarray
    points: np.ndarray
    standard_errors_px: tuple[float, ...]
    clock_errors: np.ndarray
    inconsistency: np.ndarray
    noise_px: float


def calibrate_from_silhouettes(scene: Scene, prior: CalibrationPrior) -> SilhouetteFit | None:
    """The cameras of ``scene`` that are not held out; None if no two of them see a common tangent plane.

    Masks are taken before they are made to agree over the views: that agreement is with the given cameras.
    """
    frames = _chosen_frames(scene.observed_frames)
    cameras = [scene.cameras[view] for view in scene.views]
    given = replace(scene, correct_masks=None)
    by_frame = [given.map_views(frame, lambda _, picture: outline(picture)) for frame in frames]
    outlines = [list(own) for own in zip(*by_frame, strict=True)]
    offsets = np.array([scene.time_offset(view) for view in scene.views])
    return fit_silhouettes(cameras, outlines, frames, scene.fps, prior, offsets)


def fit_silhouettes(
    cameras: Sequence[Camera],
    outlines: Sequence[Sequence[Outline | None]],
    frames: Sequence[int],
    fps: float,
    prior: CalibrationPrior,
    time_offsets: np.ndarray,
) -> SilhouetteFit | None:
    """``calibrate_from_silhouettes`` of V cameras, V lists of outlines at F ascending frames and V clocks [s]."""
    seen = Outlines.of(outlines, frames)
    points = outline_points(cameras, seen, fps)
    if points is None:
        return None
    inconsistency = consistency(tuple(range(len(cameras))), pair_errors(list(cameras), [list(o) for o in outlines]))
    problem = _Problem(cameras, seen, fps, prior, time_offsets, points, inconsistency.pixels)
    parameters, curvature, noise = _solve(problem)
    if curvature is None:
        return None
    found = problem.corrections(parameters)
    covariance = problem.basis @ np.linalg.solve(curvature, problem.basis.T)
    errors = []
    for k, jacobian in enumerate(problem.displacements):
        block = covariance[POSE * k : POSE * (k + 1), POSE * k : POSE * (k + 1)]
        errors.append(float(np.sqrt(np.einsum("pij,jk,pik->", jacobian, block, jacobian) / len(jacobian))))
    others = np.eye(len(cameras)) - (1 - np.eye(len(cameras))) / max(len(cameras) - 1, 1)
    clocks = np.einsum("ij,jk,ik->i", others, covariance[POSE - 1 :: POSE, POSE - 1 :: POSE], others)
    corrections = tuple(CameraCorrection(row[:3], row[3:6], float(row[6]), float(row[7])) for row in found)
    corrected = [corrected_camera(*one, points.pivot) for one in zip(cameras, corrections, strict=True)]
    left = consistency(tuple(range(len(cameras))), pair_errors(corrected, [list(o) for o in outlines]))
    return SilhouetteFit(corrections, points.pivot, points.points, tuple(errors), np.sqrt(clocks), left.pixels, noise)


class _Problem:
    """Residuals and prior as functions of gauge-free parameters (M,).

    basis (8 V, M): from the parameters to the corrections. precision (M, M): of the prior. displacements: V Jacobians
    (P, 2, 8) of the pixels of the object.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        outlines: Outlines,
        fps: float,
        prior: CalibrationPrior,
        time_offsets: np.ndarray,
        points: OutlinePoints,
        inconsistency: np.ndarray,
    ) -> None:
        self.cameras, self.outlines, self.fps, self.time_offsets = cameras, outlines, fps, time_offsets
        pivot, on, velocities = points.pivot, points.points, points.velocities
        self.pivot = pivot
        deviations = prior_deviations(cameras, pivot, fps, prior)
        deviations = scaled_deviations(deviations, inconsistency, cameras, pivot, on, velocities)
        steps = gauge_free_steps(cameras, pivot, on, velocities, deviations)
        # The range of the map without the gauge, whose dimension is eight less. Radians, metres and seconds have
        # nothing in common: each quantity is in units of its prior.
        units = deviations.ravel()
        vectors = np.linalg.svd(steps / units[:, None])[0]
        self.basis = units[:, None] * vectors[:, : len(units) - POSE]
        self.precision = np.zeros((self.basis.shape[1],) * 2)
        for k, (camera, deviation) in enumerate(zip(cameras, deviations, strict=True)):
            rows = self.basis[POSE * k : POSE * (k + 1)]
            self.precision += rows.T @ camera_precision(camera, pivot, deviation) @ rows
        self.displacements = [displacement_jacobian(camera, pivot, on, velocities) for camera in cameras]

    def corrections(self, parameters: np.ndarray) -> np.ndarray:
        """(V, 8)."""
        return (self.basis @ parameters).reshape(-1, POSE)

    def residuals(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (N,) [pixels], their Jacobian (N, M), and ``TangencyResiduals.groups`` (N,)."""
        found = tangency_residuals(
            self.cameras, self.outlines, self.corrections(parameters), self.pivot, self.fps, self.time_offsets
        )
        return found.angles / found.pixel_angles, self._by_parameters(found), found.groups

    def _by_parameters(self, found: TangencyResiduals) -> np.ndarray:
        rows = np.arange(len(found.angles))
        jacobian = np.zeros((len(rows), len(self.cameras), POSE))
        for k in range(2):
            jacobian[rows, found.pairs[:, k]] = found.jacobian[:, k] / found.pixel_angles[:, None]
        return jacobian.reshape(len(rows), len(self.cameras) * POSE) @ self.basis

    def largest_move(self, step: np.ndarray) -> float:
        """RMS displacement of the object [pixels] by a change of the parameters, in the picture where it is largest."""
        moves = zip(self.displacements, self.corrections(step), strict=True)
        return max(float(np.sqrt(((jacobian @ row) ** 2).sum(axis=1).mean())) for jacobian, row in moves)


def _solve(problem: _Problem) -> tuple[np.ndarray, np.ndarray | None, float]:
    """Parameters (M,) of the largest posterior density, its curvature (M, M) and the scale of the noise [pixels].

    Zero and None if there is no residual, zero if the steps do not end at a smaller loss than they began with.
    """
    parameters = np.zeros(problem.basis.shape[1])
    noise, degrees, fitted, curvature, begun = float("nan"), FEWEST_DEGREES, 0.0, None, np.zeros(0)
    for _ in range(MAX_STEPS):
        residuals, jacobian, groups = problem.residuals(parameters)
        if not len(residuals):
            return parameters, None, noise
        if curvature is None:
            begun = residuals
            noise = max(1.4826 * float(np.median(np.abs(residuals))), FINEST_NOISE_PX)
        noise, degrees = _noise(residuals, noise, degrees, fitted)
        weights = (degrees + 1) / (degrees + (residuals / noise) ** 2) / noise**2
        weights *= _independent_share(np.sqrt(weights) * residuals, groups)
        data = jacobian.T @ (weights[:, None] * jacobian)
        curvature = data + problem.precision
        step = np.linalg.solve(curvature, -jacobian.T @ (weights * residuals) - problem.precision @ parameters)
        # As many residuals as the data determine parameters are lost to them.
        fitted = float(np.trace(np.linalg.solve(curvature, data)))
        parameters = parameters + step
        if problem.largest_move(step) < CONVERGED_PX:
            break
    residuals = problem.residuals(parameters)[0]
    losses = [-student.logpdf(r / noise, degrees).mean() if len(r) else np.inf for r in (residuals, begun)]
    return parameters if losses[0] < losses[1] else 0 * parameters, curvature, noise


def _noise(residuals: np.ndarray, noise: float, degrees: float, fitted: float) -> tuple[float, float]:
    """Scale [pixels] and degrees of freedom of Student's distribution of ``residuals`` (N,), of which ``fitted`` are
    lost to parameters."""
    for _ in range(3):
        weights = (degrees + 1) / (degrees + (residuals / noise) ** 2)
        share = max(1 - fitted / len(residuals), 1 / len(residuals))
        noise = max(float(np.sqrt((weights * residuals**2).mean() / share)), FINEST_NOISE_PX)
        found = minimize_scalar(
            lambda log, scale=noise: -student.logpdf(residuals / scale, np.exp(log)).sum(),
            bounds=(np.log(FEWEST_DEGREES), np.log(MOST_DEGREES)),
            method="bounded",
            options={"xatol": 0.05},
        )
        degrees = float(np.exp(found.x))
    return noise, degrees


def _independent_share(residuals: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Share (N,) of each of the weighted ``residuals`` (N,) that is independent of the others in its group.

    A mask that is wrong at a shadow is so in all frames. n residuals with the intraclass correlation c, which is
    estimated from all groups, tell as much as n / (1 + (n - 1) c).
    """
    counts = np.bincount(groups)
    squares = float((residuals**2).sum())
    products = float((np.bincount(groups, residuals) ** 2).sum()) - squares
    pairs = float((counts * (counts - 1)).sum())
    correlation = np.clip(products / pairs * len(residuals) / squares, 0, 1) if pairs and squares else 0.0
    return 1 / (1 + (counts[groups] - 1) * correlation)


def _chosen_frames(frames: Sequence[int]) -> tuple[int, ...]:
    """At most ``MAX_FRAMES`` of ascending ``frames``."""
    if len(frames) <= MAX_FRAMES:
        return tuple(frames)
    first = np.linspace(0, len(frames) - 2, MAX_FRAMES // 2).round().astype(int)
    return tuple(frames[k] for k in np.unique([first, first + 1]))
