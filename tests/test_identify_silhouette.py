"""The silhouette of particles against masks that are known pixel by pixel."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from ring_scene import ring, spheres_scene
from test_identify import Seen

from masiv.continuum.fill import DensityField, even_points
from masiv.identify.config import IdentifyConfig
from masiv.identify.problem import Problem
from masiv.identify.silhouette import _compared, _to_world, silhouette_errors
from masiv.mpm.config import SimulatorConfig

pytestmark = pytest.mark.usefixtures("taichi")
CENTRE, RADIUS, FRAMES = np.array([0.0, 0.45, 0.0]), 0.25, 2


@pytest.fixture(scope="module", params=[0.03, 0.05])
def problem(request):
    """A ball that stands still in the air, filled evenly."""
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], frame_count=FRAMES, cameras=ring(size=128, focal=200.0))
    step = 0.01
    axis = np.arange(-0.3, 0.3 + step, step)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    inside = (np.linalg.norm(grid, axis=-1) < RADIUS).astype(np.float32)
    points = even_points(DensityField(inside, CENTRE - 0.3, step), request.param)
    still = np.repeat(points[None], FRAMES, axis=0).astype(np.float32)
    seen = Seen(still, np.arange(FRAMES) / scene.fps, len(points) * request.param**3)
    return Problem(scene, seen, IdentifyConfig(), SimulatorConfig())


def error(problem, scale):
    """Of the ball, blown up by ``scale`` about its centre."""
    middle = problem.start.mean(0)
    points = middle + scale * (problem.start - middle)
    pictures = [(1, view) for view in problem.scene.views]
    return float(silhouette_errors(problem, points.expand(problem.samples, -1, -1), pictures))


def best_scale(problem):
    scales = np.arange(0.9, 1.101, 0.02)
    return float(scales[int(np.argmin([error(problem, scale) for scale in scales]))])


def test_a_body_of_the_right_size_is_best(problem):
    """To 2 %. With half a spacing for every body, the best ball was 6 % too small."""
    assert best_scale(problem) == pytest.approx(1.0, abs=0.021)
    spacing = (problem.volume / problem.count) ** (1 / 3)
    other = copy.copy(problem)
    other.__dict__["blob_size"] = 0.5 * spacing
    assert best_scale(other) < 0.95


def test_as_many_pixels_as_the_masks(problem):
    points = _to_world(problem, problem.start)
    with torch.no_grad():
        pictures = [_compared(problem.scene, view, 0, points, problem.blob_size) for view in problem.scene.views]
    assert sum(float(d.sum()) / area for d, area in pictures) / len(pictures) == pytest.approx(0, abs=0.01)
