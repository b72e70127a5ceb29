"""The silhouette of particles against masks that are known pixel by pixel."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from ball import ball_problem, ball_scene

from masiv.identify.pictures import drawn, picture_errors, to_world, window

pytestmark = pytest.mark.usefixtures("taichi")


@pytest.fixture(scope="module", params=[0.03, 0.05])
def problem(request):
    return ball_problem(ball_scene(), request.param)


def error(problem, scale):
    """Of the ball, blown up by ``scale`` about its centre."""
    middle = problem.start.mean(0)
    points = middle + scale * (problem.start - middle)
    pictures = [(1, view) for view in problem.scene.views]
    return float(picture_errors(problem, points.expand(problem.samples, -1, -1), pictures)[0])


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
    points, excess = to_world(problem, problem.start), []
    for view in problem.scene.views:
        seen = window(problem.scene, view, 0)
        with torch.no_grad():
            alpha = drawn(seen, points, problem.blob_size, torch.zeros(problem.count, 3)).alpha
        excess.append(float((alpha - seen.mask).sum() / seen.mask.sum()))
    assert np.mean(excess) == pytest.approx(0, abs=0.01)
