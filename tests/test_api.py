"""What ``import masiv`` offers."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import masiv


def test_importing_masiv_is_light():
    code = "import masiv, sys; print(sorted({'torch', 'taichi', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", masiv.__all__)
def test_every_name_is_there_and_documented(name):
    assert getattr(masiv, name).__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        masiv.nothing  # noqa: B018


def test_evaluate_measures_a_known_displacement():
    truth = np.random.default_rng(0).uniform(size=(3, 500, 3))
    positions = truth + np.array([0.0, 3e-3, 0.0]) * np.arange(3)[:, None, None]
    numbers = masiv.evaluate(positions, truth)
    assert numbers["tracked_error_mm"] == pytest.approx(4.5, rel=1e-3)  # mean of 3 and 6 mm; frame 0 is exact


@pytest.mark.parametrize("shape", [(4, 3), (2, 5, 2)])
def test_evaluate_refuses_other_shapes(shape):
    with pytest.raises(masiv.InputError, match="shape"):
        masiv.evaluate(np.zeros(shape), np.zeros((2, 5, 3)))
