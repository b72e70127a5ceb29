"""A column of water that is let go between a wall and nothing: what is known of it on paper. No measurements needed:
those are in benchmarks/dam_break.py."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from dam_break import GRAVITY, Flow, collapse

WIDTH, RATIO = 0.06, 2.0


def first_acceleration(width: float, ratio: float) -> tuple[float, float]:
    """Of the centre of mass of an ideal incompressible fluid at rest that is let go, along x and y [m/s²].

    Its pressure solves Laplace's equation in the column: none on the open face and on top, no flow through the wall
    and the floor. p = Σ_n A_n cos(k_n x) sinh(k_n (h - y)) / cosh(k_n h) with k_n = (n + 1/2) π / a has
    A_n = 2 ρ g (-1)^n / (a k_n²). The wall's thrust moves the centre of mass sideways, the floor's holds it up.
    """
    n = np.arange(400)
    k, sign, height = (n + 0.5) * np.pi / width, (-1.0) ** n, ratio * width
    amplitude = 2 * GRAVITY * sign / (width * k**2)
    tanh, sech = np.tanh(k * height), 1 / np.cosh(np.minimum(k * height, 300.0))
    thrust, support = (amplitude / k * (1 - sech)).sum(), (amplitude * tanh * sign / k).sum()
    return thrust / (width * height), support / (width * height) - GRAVITY


@pytest.fixture(scope="module")
def flow(taichi) -> Flow:
    return collapse(width=WIDTH, ratio=RATIO, cells=10, until=1.5, piece=0.1)


def test_the_first_acceleration_is_that_of_an_ideal_fluid(flow):
    """x_cm = x_0 + a_x t² / 2 (1 + b t²): the column has no time to change its shape."""
    time = flow.times * np.sqrt(WIDTH / (2 * GRAVITY))
    early = flow.times <= 0.61
    terms = np.stack([time[early] ** 2 / 2, time[early] ** 4], axis=1)
    moved = flow.centre[early] - flow.centre[0]
    found = np.linalg.lstsq(terms, moved, rcond=None)[0][0]
    np.testing.assert_allclose(found, first_acceleration(WIDTH, RATIO), rtol=0.03)


def test_the_front_runs_no_faster_than_a_shallow_layer_and_keeps_its_volume(flow):
    """Ritter's front over a dry floor has 2 sqrt(g h): dZ/dT = 2 sqrt(ratio / 2), and none can be faster."""
    speed = np.diff(flow.front) / np.diff(flow.times)
    assert np.all(np.diff(speed) > -0.1)  # it speeds up
    assert 0.6 < speed[-1] / (2 * np.sqrt(RATIO / 2)) < 1
    assert np.abs(flow.compression[:, 0]).max() < 2e-3
    cell = WIDTH / 10
    assert flow.lowest.min() > -0.5 * cell  # nothing leaves through wall or floor
    assert abs(flow.front[0] - 1) < 1e-5
