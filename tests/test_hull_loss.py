"""The loss of a hull: zero if Gaussians fill it, with a gradient towards what they leave empty."""

import pickle

import numpy as np
import torch

from masiv.hull.carve import VisualHull
from masiv.splat.hull_loss import HullLoss, TreeCache

SPACING = 0.01


def slab(height):
    """A hull of 20 x ``height`` x 20 voxels, y up, and Gaussians that fill its lower four layers."""
    axis, up = SPACING * (np.arange(20) + 0.5), SPACING * (np.arange(height) + 0.5)
    points = np.stack(np.meshgrid(axis, up, axis, indexing="ij"), -1).reshape(-1, 3)
    inner = np.all((points > 1.5 * SPACING) & (points < np.array([18.5, height - 1.5, 18.5]) * SPACING), axis=1)
    means = points[points[:, 1] < 4 * SPACING]
    return VisualHull(points, SPACING, ~inner), torch.tensor(means, dtype=torch.float32, requires_grad=True)


def loss_of(hull, means):
    loss = HullLoss(hull)
    far = loss(means, *loss.draw(len(means), 10**6, np.random.default_rng(0)))
    (gradient,) = torch.autograd.grad(far, [means])
    return float(far.detach()), float(gradient[:, 1].sum())


def test_gaussians_that_fill_their_hull_have_no_loss():
    hull, means = slab(4)
    assert loss_of(hull, means) == (0.0, 0.0)


def test_an_empty_part_of_a_hull_attracts_gaussians():
    hull, means = slab(12)
    far, along = loss_of(hull, means)
    assert far > SPACING
    assert along < 0  # the loss falls where Gaussians rise


def test_a_hull_is_kept_small_and_to_the_last_bit():
    hull, _ = slab(12)
    shuffled = np.random.default_rng(0).permutation(len(hull.points))[:-5]
    hull = VisualHull(hull.points[shuffled] + np.array([0.3, -1 / 7, 2.1]), SPACING, hull.surface[shuffled])
    loss = HullLoss(hull)
    np.testing.assert_array_equal(loss.points(), hull.points)
    assert len(pickle.dumps(loss)) < 0.4 * hull.points.nbytes


def test_the_search_trees_of_many_hulls_are_bounded_and_change_nothing():
    hull, means = slab(12)
    cache = TreeCache(max_points=2 * len(hull.points))
    shifts = [np.array([0.0, 0.02 * k, 0.0]) for k in range(5)]
    hulls = [VisualHull(hull.points + shift, SPACING, hull.surface) for shift in shifts]
    together, alone = [HullLoss(h, cache) for h in hulls], [HullLoss(h) for h in hulls]
    drawn = alone[0].draw(len(means), 300, np.random.default_rng(1))
    for k in (0, 1, 2, 3, 4, 0, 3, 3, 1):
        assert together[k](means, *drawn) == alone[k](means, *drawn)
        assert cache.points <= cache.max_points
