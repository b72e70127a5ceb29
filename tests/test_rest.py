"""Frames at rest and the release, found in markers: of held bodies, and of none that is in motion throughout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from masiv.tracks.read import read_tracks
from masiv.tracks.rest import find_rest
from masiv.tracks.summary import summarise_tracks

FRAMES, RATE, MARKERS = 150, 100.0, 3
TIMES = np.arange(FRAMES) / RATE
seeds = st.integers(0, 2**31)


def noisy(rng, path):
    """Three markers that move along ``path`` (T, 3), with noise of 0.01 to 0.3 mm."""
    points = rng.normal(size=(MARKERS, 3)) + path[:, None]
    return points + 10 ** rng.uniform(-5, -3.5) * rng.normal(size=points.shape)


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_a_body_in_motion_is_not_said_to_rest(seed):
    rng = np.random.default_rng(seed)
    fall = rng.normal(size=3) * TIMES[:, None] - 4.9 * TIMES[:, None] ** 2 * [0, 1, 0]
    swing = rng.uniform(0.05, 0.5) * np.cos(2 * np.pi * rng.uniform(0.5, 5) * TIMES + rng.uniform(0, 6))
    for path in (fall, swing[:, None] * [1, 0.3, 0]):
        assert find_rest(TIMES, noisy(rng, path)) is None


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_rest_and_release_of_a_held_body(seed):
    rng = np.random.default_rng(seed)
    release = rng.uniform(0.15, 0.8)
    since = np.maximum(TIMES - release, 0.0)
    swing = rng.uniform(0.02, 0.1) * (1 - np.cos(2 * np.pi * rng.uniform(1, 8) * since))
    found = find_rest(TIMES, noisy(rng, swing[:, None] * [0, 1, 0.2]))
    assert found is not None
    rest, at = found
    # a slow start leaves the noise late
    assert rest.start <= 0.35 * release * RATE
    assert release * RATE - 8 <= rest.stop <= release * RATE + 12
    assert at == pytest.approx(release, abs=0.1)


def test_missing_markers_and_short_runs():
    positions = noisy(np.random.default_rng(0), np.maximum(TIMES - 0.5, 0)[:, None] * [0, 1, 0])
    positions[20] = np.nan
    rest, _ = find_rest(TIMES, positions)
    assert rest.start == 21
    assert find_rest(TIMES[:8], positions[:8]) is None
    assert find_rest(TIMES, np.full_like(positions, np.nan)) is None


def test_inspect_proposes_what_a_scene_leaves_out():
    bar = read_tracks(Path(__file__).parent / "golden" / "bar")
    bare = replace(bar, runs=tuple(replace(run, rest=None, release=None) for run in bar.runs))
    for given_, proposed in zip(summarise_tracks(bar)["runs"], summarise_tracks(bare)["runs"], strict=True):
        assert given_["proposed_rest_frames"] is None
        assert proposed["proposed_rest_frames"] == pytest.approx([0, 11], abs=1)
        assert proposed["proposed_release_s"] == pytest.approx(given_["release_s"], abs=0.012)
