"""The error of following points, from two disjoint sets of cameras."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from ring_scene import ring, spheres_scene

from masiv.config import Config
from masiv.continuum.camera_split import MIN_CAMERAS, CameraSplit, camera_halves
from masiv.errors import InputError
from masiv.inference.error_covariance import matern52
from masiv.inference.marginal_likelihood import ParameterPriors, SizePriors, marginal
from masiv.inference.motion_modes import MotionModes
from masiv.inference.segments import Segment
from masiv.observations.base import Observation
from masiv.pipeline import stages
from masiv.refinement.config import RefineConfig
from masiv.runfolder import Request, RunFolder
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.gaussians import Gaussians

CENTRE, RADIUS, FRAMES, FPS = np.array([0.0, 0.5, 0.0]), 0.25, 3, 24.0


def scene_of(cameras):
    step = np.array([0.02, 0.0, 0.0])
    return spheres_scene(lambda frame: [(CENTRE + frame * step, RADIUS)], frame_count=FRAMES, cameras=cameras)


def gaussians_that_drift(drift):
    """A few Gaussians whose motion is ``drift`` (T, 3) [m] everywhere."""
    torch.manual_seed(0)
    points = torch.tensor(CENTRE, dtype=torch.float32) + 0.2 * torch.randn(30, 3)
    network = DeformationNetwork(
        centre=torch.tensor(CENTRE).float(), half_extent=0.3, base_motion=torch.tensor(drift).float(),
        frame_count=FRAMES, fps=FPS, bases=2, width=4, depth=1,
    )  # fmt: skip
    return DynamicGaussians(
        Gaussians(points, torch.full((30,), 0.05), torch.full((30,), 0.5), torch.full((30, 3), 0.5)), network
    )


# -- the sets of cameras ----------------------------------------------------------------------------------------------


@given(
    count=st.integers(MIN_CAMERAS, 14),
    order=st.randoms(use_true_random=False),
    hidden=st.integers(0, 3),
)
def test_halves_are_disjoint_complete_and_both_surround_the_object(count, order, hidden):
    cameras = list(ring(count))
    order.shuffle(cameras)
    scene = dataclasses.replace(scene_of(tuple(cameras)), hidden_views=tuple(range(hidden)))
    halves = camera_halves(scene, CENTRE)
    if count - hidden < MIN_CAMERAS:
        assert halves is None
        return
    first, second = halves
    assert sorted(first + second) == list(scene.views)
    assert abs(len(first) - len(second)) <= 1
    if hidden == 0 and count % 2 == 0:  # on an even ring each set has every second camera, whatever their order
        for half in halves:
            numbers = sorted(int(cameras[view].name) for view in half)
            assert set(np.diff(numbers)) == {2}


def test_the_error_is_half_the_difference_of_the_motions():
    drift = np.array([[0, 0, 0], [0.1, 0.2, 0.3], [0.2, 0.4, 0.6]])
    split = CameraSplit((gaussians_that_drift(drift), gaussians_that_drift(0.5 * drift)))
    error = split.tracking_error(np.array([CENTRE, CENTRE + 0.1]), np.arange(FRAMES) / FPS)
    np.testing.assert_allclose(error, np.repeat(0.25 * drift[:, None], 2, axis=1), atol=1e-6)


# -- what the likelihood makes of it ----------------------------------------------------------------------------------

TIMES = np.arange(1, 13) / FPS
SIZES = {"translation": 6e-3, "rotation": 1e-3, "strain": 3e-3, "quadratic": 2e-3}
"""[m] that a group adds to the distance of a point, at the end."""
LENGTH = 0.15
"""Correlation time [s]."""


def errors(rng, points):
    """(T, N, 3) [m]: each group of modes wanders, smoothly in time, and grows."""
    modes = MotionModes.of(points, 3)
    covariance = matern52(np.abs(np.subtract.outer(TIMES, TIMES)) / LENGTH) + 1e-9 * np.eye(len(TIMES))
    growing = (TIMES / TIMES[-1])[:, None] * np.linalg.cholesky(covariance)
    out = np.zeros((len(TIMES), len(points) * 3))
    for name, basis in zip(modes.names, modes.bases, strict=True):
        size = SIZES[name] * np.sqrt(len(points) / basis.shape[1])
        out += size * growing @ rng.normal(size=(len(TIMES), basis.shape[1])) @ basis.T
    return out.reshape(len(TIMES), -1, 3)


def observation_of(points, tracking_error):
    error_std = np.sqrt((tracking_error**2).sum(2).mean(1))
    return Observation(
        name="a", times=TIMES, points=points, values=np.broadcast_to(points, tracking_error.shape).copy(),
        fit_count=len(TIMES), noise_std=1e-4, residual_std=np.hypot(1e-4, np.maximum.accumulate(error_std)),
        tracking_error=tracking_error,
    )  # fmt: skip


def test_expected_errors_of_a_group_are_at_least_those_of_the_draw():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(150, 3)) * 0.1
    draw = errors(rng, points)
    observation = observation_of(points, draw)
    (segment,) = Segment.of(0, observation, draw)
    (assumed,) = Segment.of(0, dataclasses.replace(observation, tracking_error=None), draw)
    larger = []
    for coefficients, smooth, share in zip(
        segment.modes.coefficients(draw), segment.smooth, assumed.smooth, strict=True
    ):
        drawn = np.maximum.accumulate(np.sqrt((coefficients**2).mean(1)))
        np.testing.assert_allclose(smooth, np.maximum(drawn, share), rtol=0.02)
        larger.append(smooth[-1] > share[-1])
    assert larger[0]  # the translation has most of this error
    assert not all(larger)


def test_without_a_draw_the_groups_share_the_expected_error():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(50, 3)) * 0.1
    measured = observation_of(points, errors(rng, points))
    assumed = dataclasses.replace(measured, tracking_error=None)
    (segment,) = Segment.of(0, assumed, np.zeros(measured.values.shape))
    widths = [basis.shape[1] for basis in segment.modes.bases]
    total = sum(k * s**2 for k, s in zip(widths, segment.smooth, strict=True))
    np.testing.assert_allclose(np.sqrt(total), assumed.observation_std)


def test_factor_on_the_measured_error_is_about_one():
    """What is left of a right model are errors of the same law as the draw: the factor that is most probable scatters
    about 1 where the draw counts."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(60, 3)) * 0.1
    logs = []
    for _ in range(12):
        segments = Segment.of(0, observation_of(points, errors(rng, points)), residual := errors(rng, points))
        blocks = [b for s in segments for b in s.blocks(residual, np.zeros((*residual.shape, 0)))]
        found = marginal(blocks, ParameterPriors(np.zeros(0), np.zeros((1, 0))), SizePriors.of(blocks))
        logs.append(np.log(found.sizes.smooth[0]))
    assert abs(np.median(logs)) < 0.4, np.exp(logs)


def test_a_draw_of_another_shape_is_refused():
    right = observation_of(np.zeros((4, 3)), np.zeros((len(TIMES), 4, 3)))
    with pytest.raises(ValueError, match="tracking_error has shape"):
        dataclasses.replace(right, tracking_error=np.zeros((len(TIMES), 5, 3)))


# -- a run ------------------------------------------------------------------------------------------------------------

SETTINGS = Config(
    refine=RefineConfig(camera_split=True),
    reconstruct=ReconstructConfig(
        gaussians=80, hull_resolution=12, crop_side=24, crop_padding=2, width=8, depth=1, space_octaves=1, iterations=8,
        processes=1, refine_calibration=False,
    ),
)  # fmt: skip


def run_of(folder):
    request = Request(SETTINGS.model_dump(mode="json"), folder, {}, FRAMES)
    run = RunFolder.create_or_resume(folder / "run", request)
    with run.stage("reconstruct"):
        gaussians_that_drift(np.zeros((FRAMES, 3))).save(run.path)
    return run


def silent(*_):
    pass


def test_a_run_measures_its_error_once_and_goes_on_after_the_first_half(taichi, tmp_path):
    run, scene = run_of(tmp_path), scene_of(ring(MIN_CAMERAS))

    def stop_in_the_second_half(stage, *_):
        if "half 2" in stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stages.ensure_camera_split(run, SETTINGS, scene, stop_in_the_second_half)
    first_half = (run.path / "camera_split/0/deformation.safetensors").stat().st_mtime_ns
    assert not (run.path / "camera_split/1").exists()
    split = stages.ensure_camera_split(run, SETTINGS, scene, silent)
    assert split is not None
    assert (run.path / "camera_split/0/deformation.safetensors").stat().st_mtime_ns == first_half
    assert not list(run.path.rglob("*.tmp"))
    assert not list(run.path.glob("checkpoints/*"))
    error = split.tracking_error(CENTRE[None], scene.times)
    assert error.shape == (FRAMES, 1, 3)
    assert np.abs(error[0]).max() < 1e-7  # frame 0 does not move
    assert 0.0 < np.abs(error[1:]).max() < RADIUS

    def work(*_):
        raise AssertionError("made again")

    again = stages.ensure_camera_split(run, SETTINGS, scene, work)
    assert again is not None
    np.testing.assert_array_equal(again.tracking_error(CENTRE[None], scene.times), error)


def test_few_cameras_are_refused_and_the_switch_counts(tmp_path):
    run = run_of(tmp_path)
    with pytest.raises(InputError, match="has 5 cameras that are not held out, and two sets need 6"):
        stages.ensure_camera_split(run, SETTINGS, scene_of(ring(MIN_CAMERAS - 1)), silent)
    off = SETTINGS.model_copy(update={"refine": RefineConfig(camera_split=False)})
    assert stages.ensure_camera_split(run, off, scene_of(ring()), silent) is None
    assert not (run.path / "camera_split").exists()
