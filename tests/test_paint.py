"""A painted ball that turns: its outline says nothing, its paint says how far."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from ball import CENTRE, RADIUS, ball_problem, ball_scene
from ring_scene import pixel_rays
from scipy.spatial.transform import Rotation

from masiv.identify.paint import paint, paint_error
from masiv.identify.pictures import picture_errors, to_world, window

pytestmark = pytest.mark.usefixtures("taichi")
TURN = 0.35  # [rad] between frames 0 and 1, about the vertical


def turned(points, angle):
    return (points - CENTRE) @ Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix().T + CENTRE


def painted_scene(*, plain=False, shade=False):
    """Stripes and patches through the ball; in frame 1 it has turned, and with ``shade`` the light has gone down and
    comes from one side."""
    scene = ball_scene()

    def load(view, frame):
        picture, camera = scene.load(view, frame), scene.cameras[view]
        rays = pixel_rays(camera)
        offset = CENTRE - camera.centre
        along = rays @ offset
        depth = along - np.sqrt(np.maximum(RADIUS**2 - (offset @ offset - along**2), 0.0))
        hit = camera.centre + depth[..., None] * rays
        x, y, z = np.moveaxis(turned(hit, -TURN * frame) - CENTRE, -1, 0) / RADIUS
        stripes, patches = np.sin(6 * x + 2 * y), np.cos(5 * z - 3 * y + 2 * x)
        colour = 0.5 + 0.2 * np.stack([stripes, patches, 0.5 * (stripes - patches)], -1)
        if plain:
            colour = np.full_like(colour, 0.5)
        if shade and frame:
            colour = colour * (0.6 + 0.15 * (hit[..., 1:2] - CENTRE[1]) / RADIUS)
        noise = 0.01 * np.random.default_rng((view, frame)).normal(size=colour.shape)
        image = np.where(picture.mask[..., None] > 0, colour + noise, 0.2)
        return dataclasses.replace(picture, image=np.round(255 * image.clip(0, 1)).astype(np.uint8))

    return dataclasses.replace(scene, load=load)


def errors(problem, angles):
    """Of silhouettes and paint, the ball turned by each angle; (A, 2)."""
    pictures, found = [(1, view) for view in problem.scene.views], []
    for angle in angles:
        points = problem.axes.points_to_simulation(turned(to_world(problem, problem.start).double().numpy(), angle))
        positions = torch.as_tensor(points, dtype=torch.float32).expand(problem.samples, -1, -1)
        found.append([float(e) for e in picture_errors(problem, positions, pictures)])
    return np.array(found)


@pytest.fixture(scope="module")
def problem():
    return ball_problem(painted_scene(), 0.03)


@pytest.mark.parametrize("shade", [False, True])
def test_paint_tells_how_far_a_ball_has_turned(shade):
    """To half a degree of 20, whatever the light does; outlines hardly differ."""
    angles = TURN + np.deg2rad([-20, -10, -2, -1, 0, 1, 2, 10, 20])
    outline, colour = errors(ball_problem(painted_scene(shade=shade), 0.03), angles).T
    assert np.ptp(outline) < 0.2 * outline.mean()
    a, b, _ = np.polyfit(angles[2:7] - TURN, colour[2:7], 2)
    assert np.rad2deg(abs(b / (2 * a))) < 0.5
    assert (np.diff(colour[:5]) < 0).all()
    assert (np.diff(colour[4:]) > 0).all()
    assert colour[4] < 0.4 * colour[0]


def test_its_derivative_is_that_of_finite_differences(problem):
    """Along the turn, at a ball that is 5 degrees behind."""
    behind, step = TURN - np.deg2rad(5), np.deg2rad(0.5)
    points = to_world(problem, problem.start).double().numpy()
    now = torch.as_tensor(turned(points, behind), dtype=torch.float32).requires_grad_()
    seen = window(problem.scene, 2, 1)
    paint_error(problem.paint, now, seen).backward()
    around = torch.as_tensor(np.cross([0.0, 1.0, 0.0], turned(points, behind) - CENTRE), dtype=torch.float32)
    there = [torch.as_tensor(turned(points, behind + s), dtype=torch.float32) for s in (step, -step)]
    ahead, back = (float(paint_error(problem.paint, p, seen)) for p in there)
    assert float((now.grad * around).sum()) == pytest.approx((ahead - back) / (2 * step), rel=0.1)


def test_what_no_camera_saw_has_no_paint(problem):
    points = to_world(problem, problem.start).double().numpy()
    depth = RADIUS - np.linalg.norm(points - CENTRE, axis=1)
    known = problem.paint.channels[:, 2].numpy() > 0
    assert known[depth < 0.02].mean() > 0.9
    assert not known[depth > 0.05].any()
    one_sided = ball_problem(dataclasses.replace(painted_scene(), hidden_views=tuple(range(1, 8))), 0.03)
    known = paint(one_sided).channels[:, 2].numpy() > 0
    behind = (points - CENTRE) @ (problem.scene.cameras[0].centre - CENTRE) < -0.1
    assert not known[behind].any()
    assert known.any()


def test_a_plain_ball_tells_nothing():
    """Noise and quantisation are no paint."""
    _, colour = errors(ball_problem(painted_scene(plain=True), 0.03), [0.0, 0.2, 0.4]).T
    assert np.ptp(colour) < 0.05
