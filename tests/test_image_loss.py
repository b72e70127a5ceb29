"""The silhouette of particles against masks that are known pixel by pixel."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch
from ball import ball_scene, ball_terms

from masiv.identification.losses import picture_window as windows_module
from masiv.identification.losses.images import ImageTerms
from masiv.identification.losses.picture_window import (
    PIXELS_A_PARTICLE,
    PictureWindows,
    particle_spacing,
    picture_window,
    render_particles,
    to_world,
)
from masiv.scene.frame_cache import Frame

pytestmark = pytest.mark.usefixtures("taichi")


@pytest.fixture(scope="module", params=[0.03, 0.05])
def terms(request):
    return ball_terms(ball_scene(), request.param)


def error(terms, scale):
    """Silhouette error of the ball, scaled by ``scale`` about its centre."""
    problem = terms.problem
    middle = problem.particles.mean(0)
    points = middle + scale * (problem.particles - middle)
    pictures = [(1, view) for view in problem.scene.views]
    return float(terms.errors(points.expand(problem.samples, -1, -1), pictures)[0])


def best_scale(terms):
    scales = np.arange(0.9, 1.101, 0.02)
    return float(scales[int(np.argmin([error(terms, scale) for scale in scales]))])


def test_a_body_of_the_right_size_is_best(terms):
    """To 2 %. With half a spacing for every body, the best ball was 6 % too small."""
    assert best_scale(terms) == pytest.approx(1.0, abs=0.021)
    other = ImageTerms(terms.problem, with_colors=False)
    other.splat_sigma = 0.5 * particle_spacing(terms.problem)
    assert best_scale(other) < 0.95


def test_as_many_pixels_as_the_masks(terms):
    problem = terms.problem
    points, excess = to_world(problem, problem.particles), []
    for view in problem.scene.views:
        window = picture_window(problem, view, 0)
        with torch.no_grad():
            alpha = render_particles(window, points, terms.splat_sigma, torch.zeros(problem.count, 3)).alpha
        excess.append(float((alpha - window.mask).sum() / window.mask.sum()))
    assert np.mean(excess) == pytest.approx(0, abs=0.01)


def enlarged(scene, factor):
    """``scene`` with each pixel as a block of ``factor`` × ``factor``."""

    def load(view, frame):
        given = scene.load(view, frame)
        parts = (given.image, given.mask, given.valid)
        return Frame(*(part.repeat(factor, axis=0).repeat(factor, axis=1) for part in parts))

    cameras = tuple(
        dataclasses.replace(
            camera, width=factor * camera.width, height=factor * camera.height,
            intrinsics=np.diag([factor, factor, 1.0]) @ camera.intrinsics,
        )
        for camera in scene.cameras
    )  # fmt: skip
    return dataclasses.replace(scene, cameras=cameras, load=load)


def test_large_pictures_are_averaged_down_to_what_the_particles_resolve(terms):
    large = ball_terms(enlarged(terms.problem.scene, 8), particle_spacing(terms.problem))
    problem = large.problem
    for view in problem.scene.views:
        window, plain = (picture_window(one.problem, view, 0) for one in (large, terms))
        focal, plain_focal = (one.camera.intrinsics[0, 0] for one in (window, plain))
        depth = plain.camera.project(to_world(problem, problem.particles).double().numpy().mean(0)[None])[1][0]
        pixels = focal * particle_spacing(problem) / depth
        assert PIXELS_A_PARTICLE <= pixels < 2 * PIXELS_A_PARTICLE
        area, plain_area = (float(one.mask.sum()) for one in (window, plain))
        assert area / focal**2 == pytest.approx(plain_area / plain_focal**2, rel=1e-3)
        assert float((window.image * window.mask[..., None]).mean((0, 1)).norm()) > 0
    assert best_scale(large) == pytest.approx(1.0, abs=0.021)
    assert error(large, 1.1) == pytest.approx(error(terms, 1.1), rel=0.1)


def counted(scene, read):
    """``scene`` without the frames that it has read. read: list to which each picture that is read is added."""

    def load(view, frame):
        read.append((view, frame))
        return scene.load(view, frame)

    return dataclasses.replace(scene, load=load)


def same(one, other):
    parts = ("image", "mask", "valid")
    cameras_agree = np.array_equal(one.camera.intrinsics, other.camera.intrinsics)
    return cameras_agree and all(torch.equal(getattr(one, n), getattr(other, n)) for n in parts)


def test_windows_are_kept_and_travel_with_the_object(terms):
    read = []
    problem = ball_terms(counted(terms.problem.scene, read), 0.05).problem
    windows, keys = PictureWindows(problem), [(view, frame) for view in problem.scene.views for frame in range(2)]
    first = [windows(*key) for key in keys]
    problem.scene.release_pictures()
    assert all(same(window, picture_window(problem, *key)) for window, key in zip(first, keys, strict=True))
    problem.scene.release_pictures()
    before = len(read)
    copied = copy.deepcopy(windows)
    assert all(same(copied(*key), windows(*key)) for key in keys)
    assert len(read) == before


def test_windows_take_bounded_memory(terms, monkeypatch):
    problem, made = terms.problem, []
    one = PictureWindows(problem)(0, 0)
    monkeypatch.setattr(windows_module, "MAX_BYTES", int(2.5 * one.nbytes))
    monkeypatch.setattr(windows_module, "picture_window", lambda *given: made.append(given[1:]) or one)
    windows = PictureWindows(problem)
    for view in (0, 1, 0, 2, 0, 1):  # 2 drops 1, which was not used for the longest time
        windows(view, 0)
    assert made == [(0, 0), (1, 0), (2, 0), (1, 0)]
