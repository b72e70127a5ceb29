"""Guesses of a frequency from the residual."""

from __future__ import annotations

import numpy as np
import pytest

from masiv.observations.base import Observation
from masiv.refinement.spectrum import OVERSAMPLING, spectral_guesses

TIMES = np.arange(1, 49) / 48


def observation(fitted=48):
    return Observation(
        name="a", times=TIMES, points=np.zeros((5, 3)), values=np.zeros((48, 5, 3)), fit_count=fitted, noise_std=1e-3,
        residual_std=np.full(48, 1e-3),
    )  # fmt: skip


def residual(frequency, phase=0.7, size=3e-3, seed=0):
    """Of a free motion that is off at the start, with an oscillation, and noise of the points."""
    motion = 0.02 - 0.05 * TIMES + size * np.cos(2 * np.pi * frequency * TIMES + phase)
    return motion[:, None, None] * [1.0, -0.5, 0.2] + np.random.default_rng(seed).normal(0, 1e-3, (48, 5, 3))


@pytest.mark.parametrize("frequency", [1.3, 4.0, 9.7, 21.0])
def test_the_highest_peak_is_at_the_frequency_of_the_residual(frequency):
    (found, *_) = spectral_guesses([observation()], [residual(frequency)])
    assert found == pytest.approx(frequency, abs=1 / OVERSAMPLING)


def test_recordings_are_taken_together_and_held_out_instants_do_not_count():
    fields = [residual(6.0), residual(6.0, phase=2.0, seed=1)]
    fields[0][30:] += np.cos(2 * np.pi * 15 * TIMES[30:])[:, None, None]
    found = spectral_guesses([observation(30), observation()], fields)
    assert found[0] == pytest.approx(6.0, abs=1 / OVERSAMPLING)


def test_a_record_of_few_instants_has_no_frequencies():
    assert spectral_guesses([observation(3)], [residual(4.0)]) == []
    assert spectral_guesses([observation(0)], [residual(4.0)]) == []
