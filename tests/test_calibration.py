"""Corrections of cameras and exposures: gradients, gauge, and cameras that were perturbed are found again."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_reconstruct import CONFIG, filmed, truth
from textured_ball import FPS, FRAMES, ball, camera_at

from masiv.calibration.from_silhouettes import calibrate_from_silhouettes
from masiv.calibration.gauge import displacement_jacobian
from masiv.checkpoint import Checkpoint
from masiv.errors import InputError
from masiv.pipeline import stages
from masiv.progress import silent
from masiv.runfolder import Request, RunFolder
from masiv.scene.calibration import NO_CORRECTION, Calibration, CameraCorrection, corrected_camera
from masiv.scene.shutter import Shutter
from masiv.splat.config import CalibrationConfig
from masiv.splat.image_formation import ImageFormation, rotate
from masiv.splat.objective import Objective, Part
from masiv.splat.observed_image import ObservedImage
from masiv.splat.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("taichi")

CAMERAS = tuple(camera_at(2 * np.pi * k / 5, 0.2 + 0.3 * (k % 3)) for k in range(5))
VELOCITY = np.array([0.7, -0.9, 0.4])
CORRECTION = CameraCorrection(np.array([0.02, -0.03, 0.015]), np.array([0.006, 0.01, -0.02]), 0.015, 0.004)


def object_points():
    """Of a ball that moves through the frames."""
    unit, _ = ball(60)
    return np.concatenate([0.2 * unit + [0, 0.5, 0] + VELOCITY * frame / FPS for frame in range(FRAMES)])


def formation(dtype=torch.float32):
    points = object_points()
    made = ImageFormation(CAMERAS, FRAMES, FPS, CalibrationConfig(), points, np.tile(VELOCITY, (len(points), 1)))
    return made.to(dtype)


def perturbed(made, seed=0):
    with torch.no_grad():
        generator = torch.Generator().manual_seed(seed)
        made.pose.copy_(torch.randn(made.pose.shape, generator=generator, dtype=made.pose.dtype))
        made.exposure.copy_(torch.randn(made.exposure.shape, generator=generator, dtype=made.pose.dtype))
    return made


def similarity(camera, pivot):
    """The camera after a small turn, shift and scaling of the world, as corrections: (7, 8) of unit parameters."""
    rotation = camera.world_to_camera[:3, :3]
    centre = rotation @ pivot + camera.world_to_camera[:3, 3]
    rows = np.zeros((7, 8))
    rows[:3, :3], rows[3:6, 3:6], rows[6, 3:6] = rotation.T, rotation.T, centre
    return rows


def test_without_corrections_points_stay_where_they_are_to_the_last_bit():
    made, points = formation(), torch.randn(50, 3)
    found = made()
    assert torch.equal(found.positions(2, points), points)
    assert torch.equal(found.time_offsets([0, 3]), torch.zeros(2))


def test_a_corrected_camera_sees_points_where_the_given_one_sees_those_that_are_moved():
    """Pixels agree exactly; a focal factor is a depth divided by it."""
    points = object_points()
    made = formation(torch.float64)
    row = torch.tensor([*CORRECTION.rotation, *CORRECTION.translation, CORRECTION.log_focal, CORRECTION.time_offset])
    found = dataclasses.replace(made(), cameras=row.expand(len(CAMERAS), 8))
    for view, camera in enumerate(CAMERAS):
        moved = found.positions(view, torch.tensor(points)).numpy()
        pixels, depth = corrected_camera(camera, CORRECTION, made.pivot).project(points)
        by_given, nearer = camera.project(moved)
        np.testing.assert_allclose(by_given, pixels, atol=2e-5)  # the given pose is kept in float32
        np.testing.assert_allclose(nearer * np.exp(CORRECTION.log_focal), depth, rtol=1e-5)


def test_rotation_is_rodrigues_and_smooth_at_zero():
    points = torch.randn(20, 3, dtype=torch.float64)
    for size in (1.0, 1e-3, 2e-5, 1e-9):
        vector = size * torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64)
        expected = Rotation.from_rotvec(vector.numpy()).apply(points.numpy()) - points.numpy()
        np.testing.assert_allclose(rotate(vector, points).numpy(), expected, atol=1e-14)
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: rotate(v, points), (zero,))


def test_the_jacobian_that_scales_the_steps_is_that_of_the_corrected_camera():
    points, pivot, step = object_points(), object_points().mean(axis=0), 1e-6
    velocities = np.tile(VELOCITY, (len(points), 1))
    for camera in CAMERAS:
        analytic = displacement_jacobian(camera, pivot, points, velocities)
        for k in range(8):
            ends = []
            for sign in (1, -1):
                row = sign * step * np.eye(8)[k]
                moved = corrected_camera(camera, CameraCorrection(row[:3], row[3:6], row[6], row[7]), pivot)
                ends.append(moved.project(points + velocities * row[7])[0])
            np.testing.assert_allclose(analytic[:, :, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-4)


def test_a_step_of_one_moves_the_object_by_at_most_a_pixel_in_its_picture():
    """Along a direction that the pictures determine by about one, or else by one prior standard deviation."""
    made, points = formation(), object_points()
    linear = made.linear.double().numpy().reshape(len(CAMERAS), 8, len(CAMERAS), 8)
    velocities = np.tile(VELOCITY, (len(points), 1))
    for view, camera in enumerate(CAMERAS):
        jacobian = displacement_jacobian(camera, made.pivot, points, velocities)
        moved = np.sqrt(((jacobian @ linear[view, :, view]) ** 2).sum(axis=1).mean(axis=0))
        assert moved.max() < 1.0 + 1e-6
        assert moved.max() > 0.3


def test_no_common_motion_scale_delay_or_brightness_is_ever_left():
    """Corrections are orthogonal to each similarity transform of the world, in mean squared pixels plus the prior."""
    made = perturbed(formation())
    found = made()
    cameras = found.cameras.detach().double().numpy()
    points, total, scale = object_points(), np.zeros(7), np.zeros(7)
    for camera, row, deviation in zip(CAMERAS, cameras, made.prior_deviations.double().numpy(), strict=True):
        jacobian = displacement_jacobian(camera, made.pivot, points, 0 * points) / np.sqrt(len(points))
        centre = camera.world_to_camera[:3, :3] @ made.pivot + camera.world_to_camera[:3, 3]

        def weighed(r, jacobian=jacobian, centre=centre, deviation=deviation):
            at_camera = np.concatenate([r[:3], r[3:6] + np.cross(centre, r[:3]), r[6:7]])
            return np.concatenate([(jacobian @ np.append(r[:7], 0)).ravel(), 0.1 * at_camera / deviation[:7]])

        for k, common in enumerate(similarity(camera, made.pivot)):
            total[k] += weighed(common) @ weighed(row)
            scale[k] += np.linalg.norm(weighed(common)) * np.linalg.norm(weighed(row))
    assert np.abs(cameras).max() > 1e-3
    np.testing.assert_array_less(np.abs(total) / scale, 1e-4)
    assert abs(cameras[:, 7].mean()) < 1e-7
    np.testing.assert_allclose(found.exposures.detach().mean(dim=(0, 1)).numpy(), 0, atol=1e-6)


def test_the_prior_counts_a_rotation_at_the_camera_and_not_about_the_object():
    """A camera that only turns has a prior of its angle; one that circles the object also of its way."""
    made = formation(torch.float64)
    deviation = made.prior_deviations[0]
    none = torch.zeros(len(CAMERAS), 8, dtype=torch.float64)
    turned, circled = none.clone(), none.clone()
    angle = torch.tensor([deviation[0], 0, 0], dtype=torch.float64)
    turned[0, :3] = circled[0, :3] = angle
    turned[0, 3:6] = torch.linalg.cross(angle, made.pivots[0])
    exposures = made().exposures
    penalties = [
        float(dataclasses.replace(made(), cameras=c, exposures=exposures).penalty().detach()) for c in (turned, circled)
    ]
    assert penalties[0] == pytest.approx(0.5, rel=1e-5)
    way = float(deviation[0]) * np.linalg.norm(made.pivots[0][1:].numpy()) / float(deviation[3])
    assert penalties[1] == pytest.approx(0.5 + 0.5 * way**2, rel=1e-5)


class Drifting:
    """A motion at constant velocity, as a network that has no parameters."""

    def changes(self, positions, times):
        moved = times[:, None, None] * torch.tensor(VELOCITY, dtype=positions.dtype)
        return moved.expand(-1, len(positions), -1), times[:, None].expand(-1, len(positions)) * 0


def test_the_gradient_of_the_image_loss_is_that_of_finite_differences():
    """For each correction of a camera and of an exposure, in float64: pictures at two frames of a moving ball."""
    generator = torch.Generator().manual_seed(1)
    camera = CAMERAS[1]
    side = camera.width
    pictures = [torch.rand(side, side, 3, generator=generator, dtype=torch.float64) for _ in range(2)]
    mask = torch.full((side, side), 0.7, dtype=torch.float64)
    seen = [[ObservedImage(1, camera, 0.7 * picture, mask, torch.ones_like(mask))] for picture in pictures]
    config = CONFIG.model_copy(update={"rigidity_weight": 0.0})
    objective = Objective(config, 0.02, 0.2, FPS, None, (), seen)
    unit, colours = ball(40)
    means = torch.tensor(0.2 * unit + [0, 0.5, 0])
    gaussians = {
        "means": means,
        "log_scales": torch.full((40,), -3.5, dtype=torch.float64),
        "opacity_logits": torch.ones(40, dtype=torch.float64),
        "colour_logits": torch.logit(torch.tensor(colours)),
    }
    made = perturbed(formation(torch.float64))
    with torch.no_grad():
        made.pose.mul_(0.3)
    pairs = torch.zeros(1, dtype=torch.long), torch.ones(1, dtype=torch.long)
    part = Part(
        ((0, objective.images[0][0], np.full(3, 0.2)), (1, objective.images[1][0], np.full(3, 0.9))),
        2,
        (),
        2,
        None,
        scale_term=False,
    )

    def loss():
        torch.set_default_dtype(torch.float64)
        try:
            return objective.part(gaussians, Drifting(), pairs, part, made)
        finally:
            torch.set_default_dtype(torch.float32)

    gradient = torch.autograd.grad(loss(), [made.pose, made.exposure])
    step = 1e-6
    checked = [(made.pose, gradient[0], (1, k)) for k in range(8)]
    checked += [(made.exposure, gradient[1], (1, frame, k)) for frame in (0, 1) for k in range(4)]
    for parameter, found, index in checked:
        ends = []
        for sign in (1, -2, 1):
            with torch.no_grad():
                parameter[index] += sign * step
                if sign != 1 or not ends:
                    ends.append(float(loss()))
        expected = (ends[0] - ends[1]) / (2 * step)
        assert float(found[index]) == pytest.approx(expected, rel=2e-3, abs=2e-7), index


def calibration_of(scene, correction=CORRECTION):
    points = object_points()
    corrections = [correction if view == 1 else NO_CORRECTION for view in scene.views]
    return Calibration.of(scene, corrections, points.mean(axis=0), points)


def test_calibration_round_trip_and_scenes_that_it_applies_to(tmp_path):
    scene = filmed(truth).restricted(holdout_cameras=(3,))
    made = calibration_of(scene)
    made.save(tmp_path)
    again = Calibration.load(tmp_path)
    for one, other in zip((*made.given, *made.refined), (*again.given, *again.refined), strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
    assert again.time_offsets == made.time_offsets == (0, CORRECTION.time_offset, 0, 0, 0, 0, 0)
    assert again.displacement_px == made.displacement_px
    assert made.displacement_px[1] > 0.5
    assert f"{made.displacement_px[1]:.2f} px for {scene.cameras[1].name}; clocks by 4.0 ms" in made.text()
    assert made.summary()[1]["focal_factor"] == pytest.approx(np.exp(CORRECTION.log_focal))
    assert made.refined[3] is made.given[3]
    row = json.loads((tmp_path / "calibration.json").read_text())["cameras"][1]
    np.testing.assert_allclose(np.radians(row["rotation_deg"]), CORRECTION.rotation, atol=1e-9)
    assert row["focal_factor"] == pytest.approx(np.exp(CORRECTION.log_focal))

    refined = again.applied_to(scene)
    np.testing.assert_array_equal(refined.cameras[1].intrinsics, made.refined[1].intrinsics)
    twice = again.applied_to(refined)
    np.testing.assert_array_equal(twice.cameras[1].world_to_camera, refined.cameras[1].world_to_camera)
    assert twice.time_offsets == refined.time_offsets == made.time_offsets
    slow = Shutter.of_image(0.01, 0.02, scene.cameras[1].height)
    rolling = dataclasses.replace(
        scene, cameras=tuple(dataclasses.replace(camera, shutter=slow) for camera in scene.cameras)
    )
    assert again.applied_to(rolling).cameras[1].shutter == slow
    other = dataclasses.replace(scene, cameras=scene.cameras[::-1])
    with pytest.raises(InputError, match="not those that were refined"):
        again.applied_to(other)
    (tmp_path / "calibration.json").write_text('{"schema": 1, "cameras": [{}]}')
    with pytest.raises(InputError, match="not a calibration"):
        Calibration.load(tmp_path)
    assert Calibration.load(tmp_path / "none") is None


def test_later_stages_see_the_refined_cameras_and_runs_without_them_the_given_ones(tmp_path):
    scene = filmed(truth)
    request = Request({"seed": 0}, tmp_path, {}, fit_frames=FRAMES - 1, holdout_cameras=(3,))
    run = RunFolder.create_or_resume(tmp_path / "run", request)
    made = calibration_of(scene.restricted(FRAMES - 1, (3,)))
    made.save(run.path)  # a reconstruct stage that was killed here is not done
    assert stages.calibrated_scene(run, scene) is scene
    with run.stage("reconstruct"):
        pass
    fitted = stages.training_scene(run, scene)
    np.testing.assert_array_equal(fitted.cameras[1].world_to_camera, made.refined[1].world_to_camera)
    assert fitted.view_time_offsets == (0, CORRECTION.time_offset, 0, 0, 0, 0)
    assert (fitted.frame_count, fitted.views) == (FRAMES - 1, (0, 1, 2, 4, 5, 6))
    (run.path / "calibration.json").unlink()  # a run of an earlier version
    assert stages.training_scene(run, scene).cameras == scene.cameras


def test_a_clock_shifts_the_motion_of_its_images_alone():
    """The points of an image are those at the frame's time plus the offset of its camera."""
    camera = CAMERAS[0]
    blank = torch.zeros(camera.height, camera.width)
    seen = [
        [ObservedImage(view, CAMERAS[view], blank[..., None].expand(-1, -1, 3), blank, blank + 1) for view in (0, 1)]
    ]
    images = seen[0]
    part = Part(
        tuple((frame, images[view], np.zeros(3)) for frame, view in ((0, 1), (1, 0), (1, 1))),
        3,
        (0, 1),
        2,
        None,
        scale_term=False,
    )
    offsets = (0.01, -0.02)
    known = Objective(CONFIG, 0.02, 0.2, FPS, None, (), [images] * 2, offsets)
    np.testing.assert_allclose(
        known._moments(part, None).times, [offsets[1], 1 / FPS + offsets[0], 1 / FPS + offsets[1]], atol=1e-7
    )
    exact = Objective(CONFIG, 0.02, 0.2, FPS, None, (), [images] * 2)
    np.testing.assert_allclose(exact._moments(part, None).times, [0, 1 / FPS], atol=1e-7)
    made = perturbed(formation())()
    found = known._moments(part, made)
    clocks = made.cameras[:, 7].detach().numpy()
    expected = [offsets[1] + clocks[1], 1 / FPS + offsets[0] + clocks[0], 1 / FPS + offsets[1] + clocks[1]]
    np.testing.assert_allclose(found.times.detach(), expected, atol=1e-7)
    assert (found.of_image, found.of_frame) == ([0, 1, 2], {0: 0, 1: 1})


def reprojection(scene, exact, cameras):
    """RMS displacement [px] of the object after the best similarity transform of the world, to first order."""
    points = object_points()
    pivot = points.mean(axis=0)
    off = np.stack([c.project(points)[0] - e.project(points)[0] for c, e in zip(cameras, exact, strict=True)])
    common = np.stack(
        [displacement_jacobian(c, pivot, points, 0 * points) @ similarity(c, pivot).T for c in exact]
    ).reshape(-1, 7)
    left = off.ravel() - common @ np.linalg.lstsq(common, off.ravel(), rcond=None)[0]
    return np.sqrt((left**2).reshape(-1, 2).sum(axis=1).mean())


@pytest.mark.slow
def test_perturbed_cameras_are_found_again():
    """Seven views of the textured ball, each turned and shifted so that the ball is about a pixel off."""
    scene = filmed(truth)
    rng = np.random.default_rng(3)
    pivot = np.array([0, 0.5, 0])
    perturbed_cameras = tuple(
        corrected_camera(c, CameraCorrection(rng.normal(0, 0.02, 3), rng.normal(0, 0.015, 3), 0.0, 0.0), pivot)
        for c in scene.cameras
    )
    given = dataclasses.replace(scene, cameras=perturbed_cameras)
    config = CONFIG.model_copy(
        update={
            "iterations": 200,
            "calibration": CalibrationConfig(rotation_deg=1.0, translation_fraction=0.015, rate_px=0.03),
        }
    )
    found = reconstruct(given, config, seed=4, checkpoint=Checkpoint(None), progress=silent).calibration
    before = reprojection(scene, scene.cameras, perturbed_cameras)
    after = reprojection(scene, scene.cameras, found.refined)
    assert before > 0.5
    assert after < 0.4 * before, (before, after)


def test_a_fit_starts_from_cameras_that_agree_with_the_silhouettes_and_the_prior_is_about_the_given_ones(tmp_path):
    """After three steps, of which none refines the cameras, the result has what the silhouettes said and no more."""
    scene = filmed(truth)
    rng = np.random.default_rng(5)
    pivot = np.array([0, 0.5, 0])
    rough = tuple(
        corrected_camera(c, CameraCorrection(rng.normal(0, 0.01, 3), rng.normal(0, 0.01, 3), 0.0, 0.0), pivot)
        for c in scene.cameras
    )
    given = dataclasses.replace(scene, cameras=rough)
    config = CONFIG.model_copy(update={"iterations": 3, "calibration": CalibrationConfig(start_fraction=0.99)})
    found = reconstruct(given, config, seed=4, checkpoint=Checkpoint(None), progress=silent).calibration
    assert found.given == rough
    assert reprojection(scene, scene.cameras, found.refined) < 0.5 * reprojection(scene, scene.cameras, rough)
    silhouettes = calibrate_from_silhouettes(given, config.calibration)
    expected = [corrected_camera(c, r, silhouettes.pivot) for c, r in zip(rough, silhouettes.corrections, strict=True)]
    for camera, other in zip(found.refined, expected, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, other.world_to_camera, atol=1e-12)
    assert found.standard_errors_px == silhouettes.standard_errors_px
    found.save(tmp_path)
    assert Calibration.load(tmp_path).standard_errors_px == found.standard_errors_px
    # The prior of the fit with Gaussians is about these cameras.
    points = object_points()
    made = ImageFormation(expected, FRAMES, FPS, config.calibration, points, 0 * points, silhouettes.inconsistency)
    assert float(made().penalty().detach()) == 0


def test_a_calibration_that_is_kept_is_not_written(tmp_path):
    config = CONFIG.model_copy(update={"iterations": 3, "refine_calibration": False})
    found = reconstruct(filmed(truth), config, seed=4, checkpoint=Checkpoint(None), progress=silent)
    found.save(tmp_path)
    assert found.calibration is None
    assert not (tmp_path / "calibration.json").exists()
