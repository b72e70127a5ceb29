"""What no two cameras show is named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ring_scene import ring, spheres_scene

from masiv.continuum.in_view import view_counts, view_problems
from masiv.scene.depth import DepthNoise
from masiv.scene.summary import summarise

CAMERAS = ring(4)
CENTRE = np.array([0.0, 0.4, 0.0])
AWAY = np.array([50.0, 0.0, 0.0])


def spheres(frame):
    """At frame 2 two cameras see a part of it."""
    return [(CENTRE + (0.75 * np.array([0.0, 0.0, 1.0]) if frame == 2 else 0), 0.2)]


@pytest.fixture
def scene():
    return spheres_scene(spheres, frame_count=4, cameras=CAMERAS)


def test_counts_are_of_the_pictures_that_a_particle_is_in(scene):
    positions = np.stack([CENTRE, CENTRE + AWAY, 2 * CAMERAS[0].centre - CENTRE])[None].repeat(4, axis=0)
    counts = view_counts(scene, positions)
    assert counts[:, 0].tolist() == [4] * 4
    # Behind the first camera, in front of that on the other side.
    behind = counts[0, 2]
    assert behind <= 1
    without = dataclasses.replace(scene, missing=frozenset({(1, 2), (3, 2)}))
    assert view_counts(without, positions)[:, 0].tolist() == [4, 4, 2, 4]
    assert view_counts(scene.restricted(holdout_cameras=(0,)), positions)[:, 0].tolist() == [3] * 4


def test_frames_that_fewer_than_two_cameras_show_are_named(scene):
    points = CENTRE + np.random.default_rng(0).normal(scale=0.05, size=(100, 3))
    positions = np.stack([points] * 4)
    assert view_problems(scene, positions) == []
    positions[1:3, :30] += AWAY
    (said,) = view_problems(scene, positions)
    assert said.startswith("frames 1–2: up to 30% of the particles are in the pictures of fewer than two cameras")
    alone = scene.restricted(holdout_cameras=(1, 2, 3))
    assert view_problems(alone, positions[:1])[0].startswith("frames 0: up to 100%")
    depth = dataclasses.replace(alone, depth_noise=DepthNoise(1e-3, 0.0))
    assert view_problems(depth, positions[:1]) == []
    assert "no camera" in view_problems(depth, positions)[0]


def test_an_object_that_the_edge_of_a_picture_cuts_is_named(scene):
    summary = summarise(scene)
    cut = [row["cut_frames"] for row in summary["cameras"]]
    assert {frame for frames in cut for frame in frames} == {2}
    (said,) = [p for p in summary["problems"] if "cuts the object" in p]
    assert said.startswith("frames 2: the edge of the picture cuts the object in up to 2 of 4 views")
    whole = spheres_scene(lambda _: spheres(0), frame_count=4, cameras=CAMERAS)
    assert not [p for p in summarise(whole)["problems"] if "cuts" in p]
