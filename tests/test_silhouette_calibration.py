"""Cameras corrected by epipolar tangency: derivatives, gauge, and cameras that were perturbed are found again."""

import dataclasses

import numpy as np
import pytest
from ring_scene import ring, spheres_scene
from scipy.spatial.transform import Rotation
from small import only_first_quick
from test_consistency import bodies, exact_outline

from benchmarks.calibration import reprojection_errors
from masiv.calibration.config import CalibrationPrior
from masiv.calibration.consistency import consistency, pair_errors
from masiv.calibration.from_silhouettes import MAX_FRAMES, calibrate_from_silhouettes, fit_silhouettes
from masiv.calibration.frontier import Outlines, tangency_residuals
from masiv.calibration.gauge import displacement_jacobian
from masiv.calibration.outline_points import outline_points
from masiv.calibration.tangency import outline, tangency_errors
from masiv.scene.calibration import corrected_camera
from masiv.scene.shutter import Shutter

FRAMES, FPS = 8, 24.0
CAMERAS = ring(11, size=160, focal=250.0)
EXACT_CLOCKS = np.zeros(len(CAMERAS))


def spheres(frame):
    """That tumble and fall."""
    parts = bodies(0)
    middle = np.mean([at for at, _ in parts], axis=0)
    turn = Rotation.from_rotvec([0.1 * frame, 0.15 * frame, 0])
    fallen = np.array([0.03 * frame, -0.002 * frame**2, 0.02 * frame])
    return [(middle + turn.apply(at - middle) + fallen, radius) for at, radius in parts]


def surface_points():
    """Of the spheres at all frames (P, 3) [m]."""
    unit = np.random.default_rng(0).normal(size=(20, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    return np.concatenate([at + radius * unit for frame in range(FRAMES) for at, radius in spheres(frame)])


SCENE = spheres_scene(spheres, cameras=CAMERAS, frame_count=FRAMES)


@pytest.fixture(scope="module")
def outlines():
    """Of the exact masks of 0 and 1."""
    return [[outline(SCENE.frame(view, frame)) for frame in range(FRAMES)] for view in range(len(CAMERAS))]


def perturbed(degrees, seed):
    """Each camera turned by ``degrees`` about each axis, 13 mm a degree from its place, focal length 2 % a degree
    (standard deviations): 0.15° comes with 2 mm and 0.3 %."""
    rng = np.random.default_rng(seed)
    made = []
    for camera in CAMERAS:
        pose, intrinsics = camera.world_to_camera.copy(), camera.intrinsics.copy()
        pose[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3)).as_matrix() @ pose[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + 0.0133 * degrees * rng.normal(size=3))
        intrinsics[:2, :2] *= 1 + 0.02 * degrees * rng.normal()
        made.append(dataclasses.replace(camera, world_to_camera=pose, intrinsics=intrinsics))
    return made


def fitted(cameras, outlines, views=None):
    """The fit, and the cameras after it."""
    chosen = range(len(cameras)) if views is None else views
    given = [cameras[view] for view in chosen]
    fit = fit_silhouettes(
        given, [outlines[view] for view in chosen], range(FRAMES), FPS, CalibrationPrior(), np.zeros(len(given))
    )
    after = [corrected_camera(c, row, fit.pivot) for c, row in zip(given, fit.corrections, strict=True)]
    return fit, given, after


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def aligned_error(cameras, exact=CAMERAS):
    """RMS displacement of the object [px] in each picture, after the similarity transform that fits best."""
    return reprojection_errors(exact, cameras, surface_points())[1]


def test_the_jacobian_is_that_of_finite_differences(outlines):
    """Of all eight corrections, at corrections that are not small, with points of tangency found anew."""
    views, step = 4, 1e-7
    seen = Outlines.of([row[:4] for row in outlines[:views]], range(4))
    pivot, clocks = np.array([0.02, 0.5, 0.01]), np.zeros(views)
    at = 0.02 * np.random.default_rng(1).normal(size=(views, 8))
    at[:, 7] = 0  # the rates of planes, which move with the pose, are taken as given
    args = (CAMERAS[:views], seen)
    found = tangency_residuals(*args, at, pivot, FPS, clocks)
    assert len(found.angles) > 40
    for view in range(views):
        for k in range(8):
            ends = []
            for sign in (1, -1):
                moved = at.copy()
                moved[view, k] += sign * step
                ends.append(tangency_residuals(*args, moved, pivot, FPS, clocks).angles)
            expected = (ends[0] - ends[1]) / (2 * step)
            analytic = sum(np.where(found.pairs[:, side] == view, found.jacobian[:, side, k], 0) for side in (0, 1))
            assert np.abs(expected).max() > 0.01
            np.testing.assert_allclose(analytic, expected, atol=2e-5)


def test_exact_outlines_have_no_residual_and_a_pixel_is_a_pixel():
    """A polytope seen by exact cameras; then the picture of one is half a pixel lower."""
    points = [0, 0.4, 0] + 0.15 * np.random.default_rng(0).normal(size=(30, 3))
    exact = [exact_outline(camera, points) for camera in CAMERAS[:2]]
    one, other = CAMERAS[0], CAMERAS[2]  # at the same height: their planes are nearly level
    exact = [exact_outline(camera, points) for camera in (one, other)]
    for shift in (0.0, 0.5):
        moved = dataclasses.replace(exact[0], hull=exact[0].hull + np.array([0, shift]))
        seen = Outlines.of([[moved], [exact[1]]], [0])
        found = tangency_residuals((one, other), seen, np.zeros((2, 8)), np.zeros(3), FPS, np.zeros(2))
        # Both outlines have an error of one pixel in the unit of the residual; here only one has.
        expected = np.abs(tangency_errors(one, moved, other, exact[1])) / np.sqrt(2)
        np.testing.assert_allclose(np.abs(found.angles / found.pixel_angles), expected, rtol=0.1, atol=1e-3)
        assert shift == 0 or expected.min() > 0.25


def test_exact_cameras_stay_exact(outlines):
    fit, _, after = fitted(CAMERAS, outlines)
    assert aligned_error(after).max() < 0.08
    assert rms(aligned_error(after)) < 0.05
    assert rms(fit.standard_errors_px) < 0.08


@pytest.mark.parametrize("seed", [0, 1])
def test_cameras_that_are_off_by_a_pixel_are_found_again(outlines, seed):
    fit, given, after = fitted(perturbed(0.15, seed), outlines)
    before, now = rms(aligned_error(given)), rms(aligned_error(after))
    assert 0.5 < before < 1.5
    assert now < before / 2
    assert now < 3 * rms(fit.standard_errors_px)


@pytest.mark.parametrize("seed", only_first_quick([0, 1]))
def test_cameras_that_are_off_by_a_degree_are_found_again(outlines, seed):
    _, given, after = fitted(perturbed(1.0, seed), outlines)
    assert rms(aligned_error(given)) > 3
    assert rms(aligned_error(after)) < rms(aligned_error(given)) / 5
    agreement = [consistency(tuple(range(11)), pair_errors(c, outlines)).pixels for c in (given, after)]
    assert np.median(agreement[1]) < np.median(agreement[0]) / 5


def test_the_gauge_of_the_given_cameras_is_kept(outlines):
    """No turn, shift, scaling or delay that all cameras share, in mean squared pixels of the object."""
    fit, given, _ = fitted(perturbed(0.15, 2), outlines)
    points = outline_points(given, Outlines.of(outlines, range(FRAMES)), FPS)
    total, scale = np.zeros(7), np.zeros(7)
    for camera, row in zip(given, fit.corrections, strict=True):
        jacobian = displacement_jacobian(camera, fit.pivot, points.points, 0 * points.points)
        rotation = camera.world_to_camera[:3, :3]
        common = np.zeros((7, 8))
        common[:3, :3] = common[3:6, 3:6] = rotation.T
        common[6, 3:6] = rotation @ fit.pivot + camera.world_to_camera[:3, 3]
        moved = jacobian @ np.array([*row.rotation, *row.translation, row.log_focal, 0])
        for k, one in enumerate(jacobian @ common.T @ np.eye(7)[j] for j in range(7)):
            total[k] += (one * moved).sum()
            scale[k] += np.linalg.norm(one) * np.linalg.norm(moved)
    # The metric also has the prior, with the weight of a tenth of a pixel.
    np.testing.assert_array_less(np.abs(total) / scale, 0.02)
    assert abs(sum(row.time_offset for row in fit.corrections)) < 1e-9


def test_a_clock_that_is_late_is_found(outlines):
    late = [list(row) for row in outlines]
    moved = spheres_scene(lambda frame: spheres(frame + 0.3), cameras=CAMERAS, frame_count=FRAMES)
    late[2] = [outline(moved.frame(2, frame)) for frame in range(FRAMES)]
    fit, _, after = fitted(CAMERAS, late)
    clocks = np.array([row.time_offset for row in fit.corrections]) * FPS
    assert clocks[2] - np.delete(clocks, 2).mean() == pytest.approx(0.3, abs=0.1)
    assert np.abs(np.delete(clocks, 2)).max() < 0.1
    assert rms(aligned_error(after)) < 0.15
    # All rows of this picture lie below the last one that is read: they are as late as the clock was.
    below = Shutter(readout_time=0.6 / FPS, first_row=-2.0, last_row=-1.0)
    known = [dataclasses.replace(c, shutter=below) if k == 2 else c for k, c in enumerate(CAMERAS)]
    again, _, _ = fitted(known, late)
    assert np.abs([row.time_offset * FPS for row in again.corrections]).max() < 0.03


def test_masks_that_say_nothing_leave_cameras_where_they_are(outlines):
    """Two cameras whose outlines are noise: the correction is a fraction of the pixels by which these are wrong."""
    rng = np.random.default_rng(3)
    poor = [
        [dataclasses.replace(seen, hull=seen.hull * (1 + 0.03 * rng.normal(size=2))) for seen in row]
        for row in outlines
    ]
    fit, _, after = fitted(CAMERAS, poor, views=(0, 1))
    assert np.median(fit.inconsistency) > 1
    assert aligned_error(after, CAMERAS[:2]).max() < 0.5


def test_the_same_numbers_every_time_and_long_recordings_in_part(outlines):
    cameras = perturbed(0.15, 4)
    one, other = (fitted(cameras, outlines, views=(0, 2, 5))[0] for _ in range(2))
    for first, second in zip(one.corrections, other.corrections, strict=True):
        np.testing.assert_array_equal(np.hstack(dataclasses.astuple(first)), np.hstack(dataclasses.astuple(second)))
    read = []
    scene = dataclasses.replace(SCENE, cameras=tuple(cameras), frame_count=1000)

    def load(view, frame):
        read.append(frame)
        return SCENE.load(view, frame % FRAMES)

    long = dataclasses.replace(scene, load=load).restricted(holdout_cameras=tuple(range(2, 11)))
    assert calibrate_from_silhouettes(long, CalibrationPrior()) is not None
    assert len(set(read)) == MAX_FRAMES
    assert {0, 1, 998, 999} <= set(read)


def test_one_camera_and_empty_masks_have_no_correction():
    def spoil(view, frame, mask):
        return 0 * mask, np.ones(mask.shape, bool)

    blank = spheres_scene(spheres, cameras=CAMERAS[:3], frame_count=2, spoil=spoil)
    assert calibrate_from_silhouettes(blank, CalibrationPrior()) is None
    alone = spheres_scene(spheres, cameras=CAMERAS[:1], frame_count=2)
    assert calibrate_from_silhouettes(alone, CalibrationPrior()) is None
