"""Images whose masks were estimated from the empty scene: what the loss compares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ring_scene import ring, spheres_scene

from masiv.scene.scene import Frame
from masiv.splat.config import ReconstructConfig
from masiv.splat.objective import Objective
from masiv.splat.observed_image import observed_image

CENTRE, RADIUS = np.array([0.0, 0.4, 0.0]), 0.3
COLOUR, EMPTY = np.array([0.8, 0.2, 0.1]), np.array([0.4, 0.5, 0.5])
OVER_EMPTY, OVER_RANDOM = torch.tensor([0.9, 0.1, 0.3]), torch.tensor([0.1, 0.1, 0.3])


def scene_with_masks(spoil):
    """A ball on a plain background, with masks that ``spoil`` changes, as if estimated."""
    exact = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(3))

    def load(view: int, frame: int) -> Frame:
        true = exact.frame(view, frame)
        picture = true.mask[..., None] * COLOUR + (1 - true.mask[..., None]) * EMPTY
        return Frame(np.rint(255 * picture).astype(np.uint8), spoil(true.mask.copy()), true.valid)

    def background(view: int) -> np.ndarray:
        return np.broadcast_to(np.rint(255 * EMPTY), (96, 96, 3)).astype(np.uint8)

    return exact, replace(exact, load=load, masks_estimated=True, background=background)


def with_a_hole(mask: np.ndarray) -> np.ndarray:
    mask[46:50, 46:50] = 0
    return mask


def loss(observed, true_alpha: torch.Tensor, background: torch.Tensor) -> float:
    objective = Objective(ReconstructConfig.model_validate({"alpha_weight": 0.0}), 1, 1, 24, None, [], [])
    rgb = true_alpha[..., None] * torch.tensor(COLOUR) + (1 - true_alpha[..., None]) * background
    return float(objective._image_loss(rgb.float(), true_alpha.float(), observed, background))


def test_a_wrong_mask_costs_nothing_over_the_empty_scene():
    exact, scene = scene_with_masks(with_a_hole)
    observed = observed_image(scene, 0, 0, crop_side=96, crop_padding=4)
    truth = observed_image(exact, 0, 0, crop_side=96, crop_padding=4)
    assert observed is not None
    assert truth is not None
    assert loss(observed, truth.mask, OVER_EMPTY) < 0.003  # rounding to 8 bits
    assert loss(observed, truth.mask, OVER_RANDOM) > 0.01


def test_a_given_mask_is_compared_over_random_backgrounds_only():
    exact, _ = scene_with_masks(with_a_hole)
    observed = observed_image(exact, 0, 0, crop_side=96, crop_padding=4)
    assert observed is not None
    assert observed.background is None


def test_the_background_is_taken_out_of_the_outline():
    """A mask of one half on a pixel that is half background: the object's part is half of its colour."""

    def halve(mask: np.ndarray) -> np.ndarray:
        return np.full(mask.shape, 0.5, np.float32) * (mask > 0)

    exact = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(3))

    def load(view: int, frame: int) -> Frame:
        true = exact.frame(view, frame)
        picture = np.where(true.mask[..., None] > 0, 0.5 * COLOUR + 0.5 * EMPTY, EMPTY)
        mask = halve(true.mask)
        mask[48, 48] = 1.0
        return Frame(np.rint(255 * picture).astype(np.uint8), mask, true.valid)

    scene = replace(
        exact, load=load, masks_estimated=True, background=lambda view: np.full((96, 96, 3), 255 * EMPTY, np.uint8)
    )
    observed = observed_image(scene, 0, 0, crop_side=96, crop_padding=60)
    assert observed is not None
    inside = (observed.mask == 0.5).numpy()
    assert observed.colour.numpy()[inside].mean(axis=0) == pytest.approx(0.5 * COLOUR, abs=0.005)
