"""A puddle under cameras that look down loses the cone above it; what flies, or stands because it must, stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ring_scene import look_at, pixel_rays, spheres_scene
from scipy.spatial import cKDTree

from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import fill_volume
from masiv.hull.carve import visual_hull
from masiv.hull.shadow_volume import MAX_VOLUME_RATIO, keep_lowest_voxels, remove_shadow_volume
from masiv.hull.silhouette import Silhouette, silhouettes

RADIUS, THICKNESS = 0.45, 0.08
BALL = (np.array([0.0, 0.55, 0.0]), (0.75 * RADIUS**2 * THICKNESS) ** (1 / 3))  # as much matter as the disc
CAMERAS = tuple(
    look_at(str(k), np.array([2.2 * np.cos(a), 1.5, 2.2 * np.sin(a)]), np.array([0.0, 0.2, 0.0]), 96, 150.0)
    for k, a in enumerate(2 * np.pi * np.arange(8) / 8)
)
RESOLUTION = 40


def flatten(view, frame, mask):
    """Frame 0 shows the ball; later ones a disc on the ground, the union of level discs."""
    if frame > 0:
        rays, centre = pixel_rays(CAMERAS[view]), CAMERAS[view].centre
        mask = np.zeros(mask.shape, bool)
        for height in np.linspace(0, THICKNESS, 9):
            at = centre + rays * ((height - centre[1]) / rays[..., 1])[..., None]
            mask |= np.hypot(at[..., 0], at[..., 2]) < RADIUS
    return mask.astype(np.float32), np.ones(mask.shape, bool)


@pytest.fixture(scope="module")
def scene():
    return spheres_scene(lambda frame: [BALL], frame_count=2, cameras=CAMERAS, spoil=flatten)


@pytest.fixture(scope="module")
def hulls(scene):
    return [visual_hull(scene, frame, resolution=RESOLUTION) for frame in (0, 1)]


def test_a_puddle_loses_the_cone_above_it(scene, hulls):
    ball, disc = hulls
    assert disc.volume > 1.4 * ball.volume
    flat = remove_shadow_volume(scene, 1, disc, ball.volume)
    assert flat.volume == pytest.approx(MAX_VOLUME_RATIO * ball.volume, abs=2 * disc.spacing**3)
    high = THICKNESS + 1.5 * disc.spacing
    assert (disc.points[:, 1] > high).mean() > 0.2
    assert (flat.points[:, 1] > high).mean() < 0.02
    assert np.hypot(*flat.points[:, [0, 2]].T).max() == pytest.approx(RADIUS, abs=1.5 * disc.spacing)
    # a shell, as of any hull: its surface is where a neighbour is missing
    neighbours = cKDTree(flat.points).query_ball_point(flat.points, 1.1 * flat.spacing, return_length=True)
    np.testing.assert_array_equal(flat.surface, neighbours < 7)


def test_no_silhouette_is_uncovered(scene, hulls):
    disc = hulls[1]
    kept = disc.points[keep_lowest_voxels(disc.points, disc.spacing, silhouettes(scene, 1), scene.up, 0.0)]
    assert len(kept) < 0.6 * len(disc.points)
    for camera in CAMERAS:
        before, depth = camera.project(disc.points)
        gap = cKDTree(camera.project(kept)[0]).query(before)[0].max()
        assert gap <= 2**0.5 * disc.spacing * camera.intrinsics[0, 0] / np.median(depth)


def test_what_has_not_grown_flies_or_has_no_ground_is_left_alone(scene, hulls):
    ball, disc = hulls
    assert remove_shadow_volume(scene, 1, disc, disc.volume / MAX_VOLUME_RATIO) is disc
    assert remove_shadow_volume(scene, 0, ball, 0.5 * ball.volume) is ball
    for other in ({"ground": None}, {"gravity": np.zeros(3)}):
        assert remove_shadow_volume(dataclasses.replace(scene, **other), 1, disc, ball.volume) is disc


def test_an_arch_stands_where_the_silhouette_needs_it():
    """Two voxels deep, seen face on: one of each pair may go, and the outline stays, however little matter is asked."""
    size, far = 0.02, 100.0
    flat = [(i, j) for i in range(-8, 8) for j in range(12) if j >= 9 or not -5 <= i < 5]
    points = size * np.array([(i + 0.5, j + 0.5, k - 0.5) for k in (0, 1) for i, j in flat])
    camera = look_at("front", np.array([0.0, 0.0, far]), np.zeros(3), 96, 2 * far / size)
    view = Silhouette(
        0, camera, np.full((96, 96), -1.0, np.float32), np.ones((96, 96), np.float32), np.ones((96, 96), bool)
    )
    stays = keep_lowest_voxels(points, size, (view,), np.array([0.0, 1.0, 0.0]), 0.0)
    assert stays.sum() == len(flat)
    np.testing.assert_array_equal(np.unique(points[stays][:, :2], axis=0), np.unique(points[:, :2], axis=0))
    # The highest go first.
    half = keep_lowest_voxels(points, size, (view,), np.array([0.0, 1.0, 0.0]), (len(points) - 10) * size**3)
    assert (~half).sum() == 10
    assert (points[~half, 1] > 11 * size).all()


def test_a_puddle_is_filled_without_its_cone(scene, hulls):
    config = TrajectoryConfig(particle_count=1500, fill_resolution=RESOLUTION)
    whole = fill_volume(scene, None, 1, config, spacing=0.02)
    flat = fill_volume(scene, None, 1, config, spacing=0.02, volume=hulls[0].volume)
    assert whole.points[:, 1].max() > 1.8 * THICKNESS
    assert flat.points[:, 1].max() < 1.5 * THICKNESS
    assert flat.volume == pytest.approx(np.pi * RADIUS**2 * THICKNESS, rel=0.12)
