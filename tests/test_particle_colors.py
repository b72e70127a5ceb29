"""A colored ball that turns: its silhouette does not change, its colors show how far it has turned."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from ball import CENTRE, RADIUS, ball_scene, ball_terms
from ring_scene import pixel_rays
from scipy.spatial.transform import Rotation

from masiv.identification.losses.particle_colors import color_correlation_loss, estimate_particle_colors
from masiv.identification.losses.picture_window import picture_window, to_world

pytestmark = pytest.mark.usefixtures("taichi")
TURN = 0.35  # [rad] between frames 0 and 1, about the vertical


def turned(points, angle):
    return (points - CENTRE) @ Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix().T + CENTRE


def colored_scene(*, plain=False, shade=False):
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


def errors(terms, angles):
    """Errors of silhouettes and colors, the ball turned by each angle; (A, 2)."""
    problem = terms.problem
    pictures, found = [(1, view) for view in problem.scene.views], []
    for angle in angles:
        points = problem.axes.points_to_simulation(turned(to_world(problem, problem.particles).double().numpy(), angle))
        positions = torch.as_tensor(points, dtype=torch.float32).expand(problem.samples, -1, -1)
        found.append([float(e) for e in terms.errors(positions, pictures)])
    return np.array(found)


@pytest.fixture(scope="module")
def terms():
    return ball_terms(colored_scene(), 0.03)


@pytest.mark.parametrize("shade", [False, True])
def test_colors_show_how_far_a_ball_has_turned(shade):
    """To half a degree of 20, with or without another light; silhouettes hardly differ."""
    angles = TURN + np.deg2rad([-20, -10, -2, -1, 0, 1, 2, 10, 20])
    silhouette, color = errors(ball_terms(colored_scene(shade=shade), 0.03), angles).T
    assert np.ptp(silhouette) < 0.2 * silhouette.mean()
    a, b, _ = np.polyfit(angles[2:7] - TURN, color[2:7], 2)
    assert np.rad2deg(abs(b / (2 * a))) < 0.5
    assert (np.diff(color[:5]) < 0).all()
    assert (np.diff(color[4:]) > 0).all()
    assert color[4] < 0.4 * color[0]


def test_the_derivative_equals_finite_differences(terms):
    """Along the turn, at a ball that is 5 degrees behind."""
    problem = terms.problem
    behind, step = TURN - np.deg2rad(5), np.deg2rad(0.5)
    points = to_world(problem, problem.particles).double().numpy()
    now = torch.as_tensor(turned(points, behind), dtype=torch.float32).requires_grad_()
    window = picture_window(problem, 2, 1)
    color_correlation_loss(terms.colors, now, window).backward()
    around = torch.as_tensor(np.cross([0.0, 1.0, 0.0], turned(points, behind) - CENTRE), dtype=torch.float32)
    there = [torch.as_tensor(turned(points, behind + s), dtype=torch.float32) for s in (step, -step)]
    ahead, back = (float(color_correlation_loss(terms.colors, p, window)) for p in there)
    assert float((now.grad * around).sum()) == pytest.approx((ahead - back) / (2 * step), rel=0.1)


def test_particles_that_no_camera_sees_have_no_color(terms):
    problem = terms.problem
    points = to_world(problem, problem.particles).double().numpy()
    depth = RADIUS - np.linalg.norm(points - CENTRE, axis=1)
    known = terms.colors.channels[:, 2].numpy() > 0
    assert known[depth < 0.02].mean() > 0.9
    assert not known[depth > 0.05].any()
    one_sided = ball_terms(dataclasses.replace(colored_scene(), hidden_views=tuple(range(1, 8))), 0.03)
    known = estimate_particle_colors(one_sided.windows).channels[:, 2].numpy() > 0
    behind = (points - CENTRE) @ (problem.scene.cameras[0].centre - CENTRE) < -0.1
    assert not known[behind].any()
    assert known.any()


def test_a_plain_ball_shows_no_turn():
    """Noise and quantisation are no colors."""
    _, color = errors(ball_terms(colored_scene(plain=True), 0.03), [0.0, 0.2, 0.4]).T
    assert np.ptp(color) < 0.05
