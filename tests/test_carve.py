from __future__ import annotations

import numpy as np
import pytest
from ring_scene import ring, spheres_scene
from scipy import ndimage

from masiv.errors import InputError, MasivError
from masiv.hull.carve import visual_hull
from masiv.hull.silhouette import sample_bilinear, signed_distance, silhouettes

CENTRE, RADIUS = np.array([0.15, 0.5, -0.1]), 0.25


def one_sphere(frame: int) -> list:
    return [(CENTRE, RADIUS)]


def test_signed_distance_is_that_to_the_nearest_pixel_of_the_other_kind():
    """Of blobs, some of which touch the border, against all pairs of pixels."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = ndimage.gaussian_filter(rng.random(rng.integers(4, 24, 2)), 2.0)
        on = mask > np.median(mask)
        pixels = np.argwhere(np.ones_like(on)).reshape(*on.shape, 2)
        to_on, to_off = (np.linalg.norm(pixels[:, :, None] - pixels[kind], axis=-1).min(-1) for kind in (on, ~on))
        assert np.allclose(signed_distance(on), np.where(on, 0.5 - to_off, to_on - 0.5), atol=1e-4)


def test_signed_distance_of_a_half_plane():
    mask = np.zeros((20, 30), np.float32)
    mask[:, 12:] = 1
    distance = signed_distance(mask)
    np.testing.assert_allclose(distance[10, :], 12 - (np.arange(30) + 0.5), atol=1e-5)
    assert sample_bilinear(distance, np.array([[12.0, 10.3]]))[0] == pytest.approx(0.0, abs=1e-5)


def test_empty_mask_is_far_away_and_full_mask_has_no_edge():
    assert (signed_distance(np.zeros((9, 12))) >= 15).all()
    assert (signed_distance(np.ones((9, 12))) < -9).all()


def test_hull_contains_the_sphere_and_little_more():
    hull = visual_hull(spheres_scene(one_sphere), 0, resolution=48)
    far = np.linalg.norm(hull.points - CENTRE, axis=1)
    ball = 4 / 3 * np.pi * RADIUS**3
    # Eight silhouettes leave a polyhedron around the ball; each pixel is about 17 mm wide.
    assert far.max() < RADIUS * 1.35
    assert 1.0 < hull.volume / ball < 1.35
    lattice = CENTRE + RADIUS * 0.97 * np.random.default_rng(0).normal(size=(500, 3)) * 0.3
    inside = lattice[np.linalg.norm(lattice - CENTRE, axis=1) < RADIUS - hull.spacing]
    nearest = np.abs(inside[:, None] - hull.points[None]).max(axis=2).min(axis=1)
    assert (nearest <= hull.spacing).all()


def test_surface_voxels_lie_on_the_outside():
    hull = visual_hull(spheres_scene(one_sphere), 0, resolution=32)
    far = np.linalg.norm(hull.points - CENTRE, axis=1)
    assert far[hull.surface].min() > 0.8 * RADIUS
    assert far[hull.surface].mean() > far[~hull.surface].mean() + 0.2 * RADIUS


def test_an_occluded_view_does_not_carve():
    def occlude(view, frame, mask):
        if view == 0:
            hidden = np.zeros(mask.shape, bool)
            hidden[:, mask.shape[1] // 2 :] = True
            return np.where(hidden, 0.0, mask).astype(np.float32), ~hidden
        return mask, np.ones(mask.shape, bool)

    clean = visual_hull(spheres_scene(one_sphere), 0, resolution=32)
    occluded = visual_hull(spheres_scene(one_sphere, spoil=occlude), 0, resolution=32)
    assert occluded.volume >= 0.99 * clean.volume


def test_two_bodies_are_both_kept_and_the_ground_cuts():
    two = [(np.array([-0.3, 0.4, 0.0]), 0.15), (np.array([0.3, 0.05, 0.0]), 0.15)]
    hull = visual_hull(spheres_scene(lambda frame: two), 0, resolution=64)
    for centre, radius in two:
        near = np.linalg.norm(hull.points - centre, axis=1) < radius
        assert near.any()
    assert hull.points[:, 1].min() > -hull.spacing


def test_a_view_without_the_object_is_named():
    def lose(view, frame, mask):
        return (np.zeros_like(mask) if view == 3 else mask), np.ones(mask.shape, bool)

    with pytest.raises(MasivError, match=r"frame 2.*view 3 contradicts"):
        visual_hull(spheres_scene(one_sphere, spoil=lose), 2)


def test_held_out_frames_and_views_are_never_read():
    read = []

    def note(view, frame, mask):
        read.append((view, frame))
        return mask, np.ones(mask.shape, bool)

    scene = spheres_scene(one_sphere, spoil=note).restricted(fit_frames=2, holdout_cameras=(5,))
    visual_hull(scene, 1, resolution=16)
    assert {view for view, _ in read} == set(range(8)) - {5}
    assert {frame for _, frame in read} == {1}
    with pytest.raises(InputError):
        visual_hull(scene, 2)


def test_large_masks_are_averaged_down_and_carve_the_same(monkeypatch):
    """Distances in metres agree to an averaged pixel, and what hides the scene still does."""

    def hide(view, frame, mask):
        shown = np.ones(mask.shape, bool)
        shown[:, : mask.shape[1] // 3] = view != 0
        return mask, shown

    scene = spheres_scene(one_sphere, cameras=ring(size=431, focal=700.0), spoil=hide)
    small, large = (silhouettes(scene, 0, resolution) for resolution in (8, None))
    assert {s.distance.shape for s in large} == {(431, 431)}
    assert all(32 <= np.sqrt((s.distance < 0).sum() * 4 / np.pi) < 64 for s in small)
    points = CENTRE + np.random.default_rng(0).uniform(-0.4, 0.4, (2000, 3))
    for reduced, whole in zip(small, large, strict=True):
        (near, _, visible), (far, _, known) = reduced.distances(points), whole.distances(points)
        both, pixel = visible & known, 2.5 / reduced.camera.intrinsics[0, 0]
        assert both.sum() > 0.95 * known.sum()
        assert not (visible & ~known).any()
        assert np.abs(near - far)[both].max() < pixel
    hull = visual_hull(scene, 0, resolution=16)
    monkeypatch.setattr("masiv.hull.silhouette.PIXELS_A_VOXEL", 1000)
    assert hull.volume == pytest.approx(visual_hull(scene, 0, resolution=16).volume, rel=0.03)
