"""A recording in which no camera has some frames: the motion goes on between the others."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from test_reconstruct import CONFIG, filmed
from textured_ball import FPS, FRAMES, ball

from masiv.checkpoint import Checkpoint
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.trajectory import estimate_trajectory
from masiv.progress import silent
from masiv.scene.frame_cache import Frame
from masiv.scene.gaps import interpolated
from masiv.splat.extend_frames import ExtendFramesConfig, extend_frames
from masiv.splat.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("taichi")

COUNT = FRAMES + 1
QUICK = CONFIG.model_copy(update={"iterations": 110, "gaussians": 150})


def thrown(unit, frame):
    """It moves along x, and along y faster and faster."""
    return 0.2 * unit + np.array([0.03 * frame, 0.5 - 0.008 * frame**2, 0.0])


def without(frames, count=COUNT):
    whole = filmed(thrown)
    lost = frozenset((view, frame) for view in range(len(whole.cameras)) for frame in frames)

    def load(view, frame):
        picture = whole.load.load(view, frame)  # type: ignore[attr-defined]
        empty = Frame(0 * picture.image, 0 * picture.mask, picture.valid & False)
        return empty if (view, frame) in lost else picture

    return dataclasses.replace(whole, load=load, frame_count=count, missing=lost)


def test_a_cubic_spline_between_frames_and_straight_lines_beyond():
    times = np.arange(8.0)
    line = np.stack([2 * times - 1, -times], axis=1)
    np.testing.assert_allclose(interpolated([1, 2, 4, 6], line[[1, 2, 4, 6]], 8), line, atol=1e-12)
    curve = np.sin(0.5 * times)[:, None]
    found = interpolated([0, 1, 2, 4, 5, 6, 7], curve[[0, 1, 2, 4, 5, 6, 7]], 8)
    assert abs(found[3] - curve[3]) < 0.01  # the mean of its neighbours is off by 0.12
    assert found[4] == curve[4]
    assert interpolated(range(8), curve, 8) is curve
    np.testing.assert_array_equal(interpolated([2], curve[[2]], 3), np.repeat(curve[[2]], 3, axis=0))


@pytest.fixture(scope="module")
def result():
    return reconstruct(without([2]), QUICK, seed=4, checkpoint=Checkpoint(None), progress=silent)


def test_the_motion_at_the_missing_frame_is_between_the_others(result):
    unit, _ = ball()
    start = torch.tensor(thrown(unit, 0)).float()
    moved = [result.deformation(start, frame / FPS)[0].detach().numpy() for frame in range(COUNT)]
    errors = [
        float(np.linalg.norm(m - (thrown(unit, k) - thrown(unit, 0)), axis=1).mean()) for k, m in enumerate(moved)
    ]
    assert errors[2] < 0.02, errors  # it has moved by 68 mm
    assert errors[2] < 1.2 * max(errors[1], errors[3]), errors


@pytest.mark.slow
def test_the_trajectory_has_the_missing_frame(result):
    config = TrajectoryConfig(particle_count=150, fill_resolution=24, iterations=40)
    found = estimate_trajectory(without([2]), result, config)
    assert found.positions.shape[0] == COUNT
    centre = found.positions.mean(axis=1)
    shift = thrown(np.zeros((1, 3)), 2) - thrown(np.zeros((1, 3)), 0)
    assert np.linalg.norm(centre[2] - centre[0] - shift) < 0.015


@pytest.mark.slow
def test_a_fit_continues_over_a_missing_frame(result):
    """The first new frame has no picture."""
    scene = without([2], 4)
    short = reconstruct(
        scene.restricted(2), QUICK.model_copy(update={"iterations": 50}), seed=4,
        checkpoint=Checkpoint(None), progress=silent,
    )  # fmt: skip
    found = extend_frames(scene, short, QUICK, ExtendFramesConfig(pretrain_steps=60), seed=4)
    unit, _ = ball()
    moved = found.deformation(torch.tensor(thrown(unit, 0)).float(), 3 / FPS)[0].detach().numpy()
    expected = thrown(unit, 3) - thrown(unit, 0)
    assert np.linalg.norm(moved.mean(axis=0) - expected.mean(axis=0)) < 0.015
