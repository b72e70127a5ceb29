"""Few particles for many: the same body, that is, its mass, its axes, and each once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from masiv.shapes import ShapeSpec, make_body
from masiv.subsample import evenly_spread, kd_tree_subset, random_subset


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_each_point_at_most_once_and_as_many_as_asked(data):
    total = data.draw(st.integers(1, 300))
    count = data.draw(st.integers(1, total))
    seed = data.draw(st.integers(0, 2**16))
    points = np.round(np.random.default_rng(seed).normal(size=(total, 3)), 1)  # with some that coincide
    chosen = kd_tree_subset(points, count)
    assert len(chosen) == count
    assert (np.diff(chosen) > 0).all()
    assert chosen[0] >= 0
    assert chosen[-1] < total


@pytest.mark.parametrize("kind", ["capsule", "cross", "torus"])
def test_mass_and_axes_are_those_of_the_body(kind):
    """Its centre within a millimetre and its moments within 2 %, where a random choice is off by several times that."""
    points = make_body(ShapeSpec(kind=kind, size=0.5, rotation_deg=(20.0, 0.0, 35.0)), 4000).particles
    random = np.random.default_rng(0).choice(len(points), 800, replace=False)

    def off(chosen):
        mean, moments = points.mean(0), np.cov(points.T)
        there = points[chosen]
        return np.linalg.norm(there.mean(0) - mean), np.linalg.norm(np.cov(there.T) - moments) / np.linalg.norm(moments)

    centre, shape = off(kd_tree_subset(points, 800))
    assert centre < 1e-3
    assert shape < 0.02
    assert centre < off(random)[0] / 3


def test_where_there_are_no_more_all_are_taken():
    points = np.random.default_rng(0).normal(size=(4, 3))
    for count in (4, 5):
        np.testing.assert_array_equal(kd_tree_subset(points, count), np.arange(4))
        np.testing.assert_array_equal(random_subset(4, count, seed=0), np.arange(4))


def test_drawn_at_random_each_once():
    chosen = random_subset(50, 20, seed=3)
    assert len(chosen) == 20
    assert (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(chosen, random_subset(50, 20, seed=3))
    assert not np.array_equal(chosen, random_subset(50, 20, seed=4))


@pytest.mark.parametrize(
    ("values", "count", "kept"),
    [
        (range(5), 5, [0, 1, 2, 3, 4]),
        (range(5), 9, [0, 1, 2, 3, 4]),
        (range(10, 21), 3, [10, 15, 20]),
        (range(120), 2, [0, 119]),
        (range(120), 0, [0]),
        ((), 4, []),
    ],
)
def test_values_are_spread_from_the_first_to_the_last(values, count, kept):
    assert evenly_spread(values, count) == kept
