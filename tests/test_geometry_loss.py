"""The geometrical objectives: what each of them sees and what it cannot see."""

import numpy as np
import pytest
import torch
from cube import scene, settings
from small import SMALL

from masiv.identification.losses.geometry import chamfer_error, surface_points, trajectory_errors
from masiv.identification.stage import identify


def lattice(side=7):
    axis = torch.arange(side, dtype=torch.float32)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def test_a_chamfer_distance_does_not_see_which_particle_is_which():
    points = lattice()
    mixed = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    assert float(chamfer_error(mixed[None], points[None])) < 1e-5
    assert float(trajectory_errors(mixed[None], points[None])) > 1


def test_chamfer_of_a_small_shift_is_the_shift_and_pulls_back():
    points = lattice()
    shift = torch.tensor([0.1, 0.0, 0.0], requires_grad=True)
    error = chamfer_error((points + shift)[None], points[None])
    error.backward()
    assert float(error.detach()) == pytest.approx(0.1, rel=1e-4)
    np.testing.assert_allclose(shift.grad, [1.0, 0.0, 0.0], atol=1e-4)


def test_the_surface_of_a_cube_is_its_outer_layer():
    points = lattice().numpy()
    outer = ((points == 0) | (points == 6)).any(axis=1)
    np.testing.assert_array_equal(surface_points(points), outer)


@pytest.mark.parametrize("loss", ["continuum", "surface"])
def test_a_fit_to_sets_of_points_ends_near_the_motion(seen, loss):
    twin = identify(scene(), seen[0], settings(geometry_loss=loss, iterations=6), SMALL)
    assert twin.fit["geometry_loss"] == loss
    assert twin.fit["trajectory_error_mm"] < 30
