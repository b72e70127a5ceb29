"""Hulls and masks when one view contradicts the others."""

from __future__ import annotations

import numpy as np
import pytest
from ring_scene import ring, spheres_scene
from small import only_first_quick

from masiv.hull.carve import visual_hull
from masiv.hull.consistent_masks import consistent_masks
from masiv.hull.mask_quality import mask_quality
from masiv.hull.volume import hull_ratio, hull_ratios, volume_prior

CENTRE, RADIUS = np.array([0.15, 0.5, -0.1]), 0.25
ARM = np.array([0.15, 0.85, -0.1])


def body_with_arm(frame: int) -> list:
    return [(CENTRE, RADIUS), (ARM, 0.14)]


def cut_the_arm(view: int, frame: int, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """View 2 misses the upper part of the object."""
    if view == 2:
        rows = np.flatnonzero((mask > 0.5).any(axis=1))
        mask = mask.copy()
        mask[: rows[0] + len(rows) // 4] = 0
    return mask, np.ones(mask.shape, bool)


def test_a_part_that_one_view_misses_survives():
    clean = visual_hull(spheres_scene(body_with_arm), 0, resolution=48)
    spoilt = visual_hull(spheres_scene(body_with_arm, spoil=cut_the_arm), 0, resolution=48)
    assert spoilt.volume > 0.9 * clean.volume
    assert spoilt.points[:, 1].max() > clean.points[:, 1].max() - 2 * clean.spacing


def test_four_views_cannot_outvote_one():
    cameras = ring(4)
    clean = visual_hull(spheres_scene(body_with_arm, cameras=cameras), 0, resolution=32)
    spoilt = visual_hull(spheres_scene(body_with_arm, cameras=cameras, spoil=cut_the_arm), 0, resolution=32)
    assert spoilt.points[:, 1].max() < clean.points[:, 1].max() - 2 * clean.spacing


def test_a_missing_part_is_added_to_the_mask():
    clean, spoilt = spheres_scene(body_with_arm), spheres_scene(body_with_arm, spoil=cut_the_arm)
    truth = clean.frame(2, 0).mask > 0.5
    before = spoilt.frame(2, 0).mask > 0.5
    after = consistent_masks(spoilt, 0)[2].mask > 0.5
    missing = truth & ~before
    assert after[missing].mean() > 0.7
    assert (after & ~truth).sum() < 0.1 * truth.sum()


def test_a_hole_that_the_others_cover_is_filled_and_a_stain_is_removed():
    def spoil(view: int, frame: int, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mask = mask.copy()
        if view == 1:
            rows, columns = (int(np.median(i)) for i in np.nonzero(mask > 0.5))
            mask[rows - 2 : rows + 3, columns - 3 : columns + 3] = 0
        if view == 4:
            mask[2:14, 2:14] = 1
        return mask, np.ones(mask.shape, bool)

    clean, spoilt = spheres_scene(body_with_arm), spheres_scene(body_with_arm, spoil=spoil)
    found = consistent_masks(spoilt, 0)
    for view in (1, 4):
        truth = clean.frame(view, 0).mask > 0.5
        assert ((found[view].mask > 0.5) != truth).sum() < 0.05 * truth.sum()


def test_exact_masks_are_hardly_changed():
    scene = spheres_scene(body_with_arm)
    for view, picture in consistent_masks(scene, 0).items():
        truth = scene.frame(view, 0).mask > 0.5
        assert ((picture.mask > 0.5) != truth).sum() <= 0.03 * truth.sum()


def test_mask_quality_names_the_bad_view():
    good = mask_quality(spheres_scene(body_with_arm))
    assert np.nanmin(good.agreement) > 0.85
    assert np.ptp(good.agreement) < 0.05
    assert good.problems() == []
    bad = mask_quality(spheres_scene(body_with_arm, spoil=cut_the_arm))
    assert len(bad.problems()) == 1
    assert bad.problems()[0].startswith("view 2:")


@pytest.mark.parametrize("count", only_first_quick([4, 8]))
def test_the_volume_is_within_its_uncertainty(count):
    """The hull of a ball in few cameras is larger than the ball; the prior allows for that."""
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(count), frame_count=2)
    hull = visual_hull(scene, 0, resolution=40)
    ball = 4 / 3 * np.pi * RADIUS**3
    prior = volume_prior(scene, {0: hull})
    assert hull.volume > 1.03 * ball
    # Of all shapes a ball fills its hull best.
    assert abs(np.log(prior.volume / ball)) < 2.5 * prior.log_sd
    assert 0.02 < prior.log_sd < 0.2


def test_the_hull_of_a_drawn_shape_is_that_of_its_exact_masks():
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(8), frame_count=2)
    hull = visual_hull(scene, 0, resolution=56)
    exact = hull.volume / (4 / 3 * np.pi * RADIUS**3)

    def ball(points):
        return np.linalg.norm(points, axis=1) < 1

    drawn = hull_ratio(ball, scene, CENTRE, RADIUS, hull.spacing, np.random.default_rng(0))
    assert drawn == pytest.approx(exact, rel=0.03)


@pytest.mark.slow
def test_more_cameras_leave_less_phantom_volume():
    few, many = (hull_ratios(spheres_scene(body_with_arm, cameras=ring(n)), CENTRE, 0.3, 0.01).mean() for n in (3, 8))
    assert few > many > 1.0
