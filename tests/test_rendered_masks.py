"""Masks of later stages: those of the Gaussians if masks were estimated, else those that were given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ring_scene import ring, spheres_scene
from still import still

from masiv.scene.calibration import Calibration, CameraCorrection
from masiv.scene.scene import Frame
from masiv.scene.shutter import Shutter
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.rendered_masks import as_reconstructed

pytestmark = pytest.mark.usefixtures("taichi")
CENTRE, RADIUS = np.array([0.0, 0.4, 0.0]), 0.3


def filled_ball(spacing: float = 0.025):
    axis = np.arange(-RADIUS, RADIUS + spacing, spacing)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return still(CENTRE + points[np.linalg.norm(points, axis=1) < RADIUS - spacing], 0.6 * spacing)


def with_a_hole(view: int, frame: int, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mask[40:54, 42:54] = 0
    valid = np.ones(mask.shape, bool)
    valid[:, :40] = view != 2
    return mask, valid


def scenes(**changes):
    """The exact scene, and one whose masks have a hole; an occluder hides the left of view 2."""
    exact, spoilt = (
        spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(3), spoil=s) for s in (None, with_a_hole)
    )
    return exact, replace(spoilt, **changes)


def overlap(one: Frame, other: Frame, where: np.ndarray) -> float:
    a, b = one.mask[where] > 0.5, other.mask[where] > 0.5
    return (a & b).sum() / (a | b).sum()


def test_a_hole_that_the_gaussians_do_not_have_is_filled():
    exact, scene = scenes(masks_estimated=True)
    found = as_reconstructed(scene, filled_ball())
    for view in found.views:
        picture, everywhere = found.frame(view, 2), np.ones((96, 96), bool)
        given = scene.frame(view, 2)
        assert overlap(given, exact.frame(view, 2), everywhere) < 0.93
        assert overlap(picture, exact.frame(view, 2), picture.valid) > 0.96
        assert not picture.mask[~picture.valid].any()
        assert np.array_equal(picture.image, given.image)


def test_given_masks_are_kept():
    _, scene = scenes()
    assert np.array_equal(as_reconstructed(scene, filled_ball()).frame(0, 1).mask, scene.frame(0, 1).mask)


def test_masks_are_those_in_the_refined_cameras():
    _, scene = scenes(masks_estimated=True)
    turned = CameraCorrection(np.zeros(3), np.array([0.05, 0.0, 0.0]), 0.0, 0.0)
    none = CameraCorrection(np.zeros(3), np.zeros(3), 0.0, 0.0)
    calibration = Calibration.of(scene, (turned, none, none), CENTRE, CENTRE[None])
    dynamic = filled_ball()
    plain = as_reconstructed(scene, dynamic)
    found = as_reconstructed(scene, replace(dynamic, calibration=calibration))
    columns = [np.nonzero(s.frame(0, 0).mask > 0.5)[1].mean() for s in (plain, found)]
    focal, depth = scene.cameras[0].intrinsics[0, 0], np.linalg.norm(scene.cameras[0].centre - CENTRE)
    assert columns[1] - columns[0] == pytest.approx(0.05 * focal / depth, rel=0.1)
    assert np.array_equal(found.frame(1, 0).mask, plain.frame(1, 0).mask)


def test_a_rolling_shutter_shears_the_mask_of_a_moving_object():
    """A ball that rises is read from the top: rows below are read later, when it is higher, so it looks flatter."""
    _, scene = scenes(masks_estimated=True)
    dynamic, rise = filled_ball(), torch.zeros(4, 3)
    rise[:, 1] = 0.2 * torch.arange(4)
    network = dynamic.deformation
    moving = DeformationNetwork(**{**network.settings, "centre": network.centre, "base_motion": rise})
    dynamic = replace(dynamic, deformation=moving.requires_grad_(False))
    rolling = tuple(replace(c, shutter=Shutter.of_image(0.0, 0.04, c.height)) for c in scene.cameras)
    masks = [
        as_reconstructed(replace(scene, cameras=cameras), dynamic).frame(0, 1).mask
        for cameras in (scene.cameras, rolling)
    ]
    heights = [np.ptp(np.nonzero(mask > 0.5)[0]) + 1 for mask in masks]
    pixels_a_row = 0.2 * 24 * 0.04 * 150 / 2.5 / 96
    assert heights[1] / heights[0] == pytest.approx(1 / (1 + pixels_a_row), abs=0.05)
