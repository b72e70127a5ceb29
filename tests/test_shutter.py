"""Motion blur and rolling shutter: images drawn row by row and instant by instant, and what the model makes of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from ring_scene import pixel_rays, ring, spheres_scene
from textured_ball import FPS, SIDE, ball, camera_at

from masiv.continuum.losses import load_views, outside_of_mask
from masiv.errors import InputError
from masiv.hull.carve import visual_hull
from masiv.hull.velocity import with_velocities
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.frame_cache import Frame
from masiv.scene.shutter import Shutter
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.losses import neighbour_pairs
from masiv.splat.objective import Objective, Part
from masiv.splat.observed_image import ObservedImage
from masiv.splat.rasteriser import render
from masiv.splat.shutter import MAX_SAMPLES, SAMPLE_STEP, at_row, expose, sample_count, velocities

pytestmark = pytest.mark.usefixtures("taichi")

UNIT, COLOURS = ball(300)
POINTS = torch.tensor(0.2 * UNIT + np.array([0, 0.5, 0]))
BLACK = torch.zeros(3, dtype=torch.float64)
BLURRED = Shutter.of_image(0.9 / FPS, 0.0, SIDE)
ROLLING = Shutter.of_image(0.0, 0.9 / FPS, SIDE)
BOTH = Shutter.of_image(0.4 / FPS, -0.5 / FPS, SIDE)
VELOCITY = torch.tensor([1.5, -3.0, 0.5], dtype=torch.float64)  # 7 pixels a frame


def camera(shutter, angle=0.4):
    return dataclasses.replace(camera_at(angle, 0.6), shutter=shutter)


def drawn(camera, points):
    size = torch.full((len(points),), 0.016, dtype=points.dtype)
    colours = torch.tensor(COLOURS, dtype=points.dtype)
    return camera, points, size, 0 * size + 0.95, colours, BLACK.to(points.dtype)


def filmed(camera, at, samples=24):
    """rgb and alpha of what is at ``at(time)``, row by row and instant by instant, as a camera exposes it."""
    rgb, alpha = torch.zeros(SIDE, SIDE, 3).double(), torch.zeros(SIDE, SIDE).double()
    times = camera.shutter.row_times(np.arange(SIDE) + 0.5)
    for time in np.unique(times):
        rows = torch.tensor(times == time)
        for k in range(samples if camera.shutter.exposure_time else 1):
            offset = camera.shutter.exposure_time * ((k + 0.5) / samples - 0.5)
            picture = render(*drawn(camera, at(time + offset)))
            rgb[rows] += picture.rgb[rows]
            alpha[rows] += picture.alpha[rows]
    count = samples if camera.shutter.exposure_time else 1
    return rgb / count, alpha / count


def exposed(camera, points, velocity):
    seen, where, *rest = drawn(camera, points)
    exposed = expose(seen, where, velocity.expand(len(points), 3), *rest)
    return exposed.rgb, exposed.alpha


@pytest.mark.parametrize(("shutter", "left"), [(BLURRED, 0.1), (ROLLING, 0.3), (BOTH, 0.3)])
def test_the_model_draws_what_such_a_camera_sees(shutter, left):
    """Up to a ``left`` fraction of the error: rows that are read later also stretch each Gaussian, here by 18 %."""
    seen_by = camera(shutter)
    rgb, alpha = filmed(seen_by, lambda time: POINTS + VELOCITY * time)
    model = exposed(seen_by, POINTS, VELOCITY)
    instant = render(*drawn(seen_by, POINTS))
    wrong = float((instant.rgb - rgb).abs().mean())
    assert wrong > 0.01
    assert float((model[0] - rgb).abs().mean()) < left * wrong
    assert float((model[1] - alpha).abs().mean()) < left * float((instant.alpha - alpha).abs().mean())


def test_a_gaussian_is_where_it_is_when_its_row_is_read():
    seen_by = camera(ROLLING)
    speed = VELOCITY.expand(len(POINTS), 3)
    moved = at_row(seen_by, POINTS, speed, 0.0)
    rows = torch.tensor(seen_by.project(moved.numpy())[0][:, 1])
    read = ((moved - POINTS) @ VELOCITY) / (VELOCITY @ VELOCITY)
    assert (read - seen_by.shutter.row_times(rows)).abs().max() < 0.01 * ROLLING.readout_time
    assert read.max() - read.min() > 0.2 * ROLLING.readout_time


def test_top_row_first_and_the_middle_row_at_the_frames_time():
    rows = np.array([0.5, SIDE / 2, SIDE - 0.5])
    np.testing.assert_allclose(ROLLING.row_times(rows) / ROLLING.readout_time, [-0.5, 0, 0.5])
    part = ROLLING.cropped(8).reduced(2)  # its row y is 2 y + 8
    np.testing.assert_allclose(part.row_times((rows - 8) / 2), ROLLING.row_times(rows))
    np.testing.assert_allclose(part.row_times(np.array([-1e3, 1e3])) / ROLLING.readout_time, [-0.5, 0.5])


def test_gradients_match_finite_differences():
    seen_by = camera(BOTH)
    weights = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0)).double()
    points, speed = POINTS.clone().requires_grad_(), VELOCITY.clone().requires_grad_()

    def value(points, speed):
        rgb, alpha = exposed(seen_by, points, speed)
        return (rgb * weights).sum() + (alpha * weights[..., 0]).sum()

    gradients = torch.autograd.grad(value(points, speed), (points, speed))
    rng = torch.Generator().manual_seed(1)
    for gradient, vary in ((gradients[0], 0), (gradients[1], 1)):
        direction = torch.randn(gradient.shape, generator=rng).double()
        direction *= [1e-6, 1e-5][vary]
        with torch.no_grad():
            ends = [value(*(p + sign * direction if k == vary else p for k, p in enumerate((POINTS, VELOCITY))))
                    for sign in (1, -1)]  # fmt: skip
        expected = float((gradient * direction).sum())
        assert float(ends[0] - ends[1]) / 2 == pytest.approx(expected, rel=2e-3)


def test_enough_samples_and_no_more():
    still = camera(Shutter.of_image(0.02, 0.0, SIDE))
    assert sample_count(still, POINTS, 0 * POINTS) == 1
    for speed in (0.5, 3.0, 6.0):
        velocity = torch.tensor([0.0, speed, 0.0]).double().expand(len(POINTS), 3)
        ends = [still.project((POINTS + sign * 0.01 * velocity).numpy())[0] for sign in (1, -1)]
        motion = np.quantile(np.linalg.norm(ends[0] - ends[1], axis=1), 0.95)
        assert sample_count(still, POINTS, velocity) == pytest.approx(motion / SAMPLE_STEP, abs=1.05)
    assert sample_count(still, POINTS, 100 * velocity) == MAX_SAMPLES


def test_the_bias_of_motion_and_shape_is_gone_with_the_key_and_present_without():
    """Start, velocity and height of the ball, fitted to the images of two frames and two cameras with rolling shutter.

    A ball that falls while it is read from the top is drawn too high, and its image moves too fast.
    """
    velocity = torch.tensor([0.3, -3.0, 0.2]).double()
    cameras = [camera(ROLLING, angle) for angle in (0.2, 1.9)]
    images = [[filmed(c, lambda t, k=k: POINTS + velocity * (t + k / FPS), 8) for k in (-0.5, 0.5)] for c in cameras]

    one = torch.ones(()).double()

    def fit(known):
        start, speed = torch.zeros(3).double().requires_grad_(), (0.8 * velocity).clone().requires_grad_()
        height = torch.ones(()).double().requires_grad_()
        optimiser = torch.optim.LBFGS([start, speed, height], max_iter=25, line_search_fn="strong_wolfe")

        def loss():
            optimiser.zero_grad()
            total = torch.zeros(()).double()
            for seen_by, two in zip(cameras, images, strict=True):
                model = seen_by if known else dataclasses.replace(seen_by, shutter=Shutter())
                for k, (rgb, alpha) in zip((-0.5, 0.5), two, strict=True):
                    points = POINTS * torch.stack([one, height, one]) + start
                    found = exposed(model, points + speed * k / FPS, speed)
                    total = total + (found[0] - rgb).square().mean() + (found[1] - alpha).square().mean()
            total.backward()
            return total

        optimiser.step(loss)
        return float((speed.detach() - velocity).norm() / velocity.norm()), float(height.detach())

    (speed_error, height), (wrong_speed, wrong_height) = fit(known=True), fit(known=False)
    assert speed_error < 0.01
    assert height == pytest.approx(1, abs=0.04)  # the Gaussians themselves are not stretched
    assert wrong_speed > 0.1
    assert wrong_height > 1.1


def test_the_loss_of_reconstruct_is_least_with_the_right_shutter():
    """At the true motion: a network whose base motion moves the ball."""
    times = torch.arange(4) / FPS
    velocity = VELOCITY.float()
    network = DeformationNetwork(
        centre=torch.tensor([0, 0.5, 0]),
        half_extent=0.25,
        frame_count=4,
        fps=FPS,
        base_motion=times[:, None] * velocity,
    )
    gaussians = {
        "means": POINTS.float(),
        "log_scales": torch.full((len(POINTS),), float(np.log(0.016))),
        "opacity_logits": torch.full((len(POINTS),), float(np.log(0.95 / 0.05))),
        "colour_logits": torch.logit(torch.tensor(COLOURS).float()),
    }
    pairs = neighbour_pairs(POINTS.numpy(), 4)
    shutters = {
        "right": BOTH,
        "none": Shutter(),
        "bottom first": dataclasses.replace(BOTH, readout_time=-BOTH.readout_time),
        "no blur": dataclasses.replace(BOTH, exposure_time=0.0),
    }
    losses = {}
    for frame in (0, 2):
        rgb, alpha = filmed(camera(BOTH), lambda time, f=frame: POINTS + VELOCITY * (time + f / FPS), 8)
        for name, shutter in shutters.items():
            observed = ObservedImage(0, camera(shutter), rgb.float(), alpha.float(), torch.ones(SIDE, SIDE))
            part = Part(((frame, observed, np.full(3, 0.4)),), 1, (), 1, None, scale_term=False)
            objective = Objective(ReconstructConfig(), 0.016, 0.25, FPS, None, {}, {})
            losses[name] = float(objective.part(gaussians, network, pairs, part).detach())
        assert min(losses, key=lambda name: losses[name]) == "right", (frame, losses)
        assert losses["right"] < 0.5 * losses["none"], (frame, losses)


def test_the_velocity_ends_with_the_recording():
    base = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    network = DeformationNetwork(centre=torch.zeros(3), half_extent=1.0, frame_count=3, fps=10.0, base_motion=base)
    seen_by = camera(Shutter.of_image(0.04, 0.06, SIDE))
    for time in (0.0, 0.1, 0.2):
        first, last = max(0.0, time - 0.05), min(0.2, time + 0.05)
        ends = network.base_displacements(torch.tensor([first, last])).detach()
        found = velocities(network, torch.zeros(2, 3), time, seen_by).detach()
        np.testing.assert_allclose(found[0], (ends[1] - ends[0]) / (last - first), rtol=1e-5)


def test_declared_for_all_cameras_or_by_name():
    cameras = [dataclasses.replace(camera_at(a, 0.5), name=name) for a, name in ((0, "left"), (1, "right"))]
    one = SceneDeclaration(exposure_time=0.01, readout_time=-0.02).shutters(cameras, 24)
    assert [(s.exposure_time, s.readout_time, s.last_row) for s in one] == 2 * [(0.01, -0.02, SIDE - 0.5)]
    some = SceneDeclaration(readout_time={"right": 0.03}).shutters(cameras, 24)
    assert [(s.is_instant, s.readout_time) for s in some] == [(True, 0), (False, 0.03)]
    with pytest.raises(InputError, match="names camera 'top', the cameras are left, right"):
        SceneDeclaration(exposure_time={"top": 0.01}).shutters(cameras, 24)
    with pytest.raises(InputError, match="exposure_time is 10 s, a frame has 0"):
        SceneDeclaration(exposure_time=10.0).shutters(cameras, 24)


def falling_sphere(readout_time):
    """A sphere that crosses 40 of 160 rows between two frames; every row shows it when it is read."""
    cameras = ring(6, size=160, focal=250.0)
    velocity, start = np.array([1.5, -6.0, 0.0]), np.array([-0.1, 0.9, 0.0])
    shutters = [Shutter.of_image(0.0, readout_time * sign, 160) for sign in (1, 1, 1, -1, -1, 0)]
    cameras = tuple(dataclasses.replace(c, shutter=s) for c, s in zip(cameras, shutters, strict=True))

    def load(view, frame):
        camera, rays = cameras[view], pixel_rays(cameras[view])
        times = frame / 24 + camera.shutter.row_times(np.arange(160) + 0.5)
        offset = start + times[:, None] * velocity - camera.centre
        along = (rays * offset[:, None]).sum(-1)
        mask = (offset**2).sum(-1)[:, None] - along**2 < 0.2**2
        return Frame(np.zeros((160, 160, 3), np.uint8), mask.astype(np.float32), np.ones((160, 160), bool))

    scene = dataclasses.replace(spheres_scene(lambda _: [], cameras=cameras, frame_count=3), load=load, ground=None)
    return scene, start + velocity / 24 * np.arange(3)[:, None], velocity


def test_a_hull_is_that_of_the_frames_time():
    """The volume and the place of a sphere whose silhouettes are sheared and shifted, up or down."""
    plain, centres, velocity = falling_sphere(0.0)
    assert with_velocities(plain) is plain
    scene, *_ = falling_sphere(0.02)
    known = with_velocities(scene)
    assert known.velocities is not None
    np.testing.assert_allclose(known.velocities, np.tile(velocity, (3, 1)), atol=0.1 * np.linalg.norm(velocity))
    exact = visual_hull(plain, 0, resolution=32).volume
    right, wrong = (visual_hull(s, 0, resolution=32) for s in (known, scene))
    assert right.volume == pytest.approx(exact, rel=0.04)
    assert wrong.volume < 0.85 * exact
    assert np.linalg.norm(right.points.mean(axis=0) - centres[0]) < 0.005


def test_points_of_the_object_are_not_outside_of_its_sheared_masks():
    """The silhouette term of the trajectory."""
    scene, centres, velocity = falling_sphere(0.02)
    points = torch.tensor(centres[0] + 0.196 * UNIT, dtype=torch.float32)
    known = dataclasses.replace(scene, velocities=np.tile(velocity, (3, 1)))
    for right, wrong in zip(load_views(known)[0][:5], load_views(scene)[0][:5], strict=True):
        assert outside_of_mask(points, right).max() < 0.003
        assert outside_of_mask(points, wrong).max() > 0.01


def test_a_hull_takes_each_clock_into_account():
    """Views 1 and 4 are a quarter of a frame late and early."""
    offsets = (0.0, 0.25 / 24, 0.0, 0.0, -0.25 / 24, 0.0)
    plain, centres, velocity = falling_sphere(0.0)
    cameras = plain.cameras

    def load(view, frame):
        offset = centres[frame] + offsets[view] * velocity - cameras[view].centre
        mask = offset @ offset - (pixel_rays(cameras[view]) @ offset) ** 2 < 0.2**2
        return Frame(np.zeros((160, 160, 3), np.uint8), mask.astype(np.float32), np.ones((160, 160), bool))

    late = dataclasses.replace(plain, load=load)
    known = with_velocities(dataclasses.replace(late, time_offsets=offsets), centres)
    exact = visual_hull(plain, 1, resolution=32).volume
    assert visual_hull(known, 1, resolution=32).volume == pytest.approx(exact, rel=0.03)
    assert visual_hull(late, 1, resolution=32).volume < 0.85 * exact
