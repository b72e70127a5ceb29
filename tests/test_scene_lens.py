"""The lens against the formula of Brown and Conrady, written by hand, and the listings that state a lens."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from masiv.errors import InputError
from masiv.scene.lens import Lens, read_lens

WIDTH, HEIGHT = 64, 48
K = np.array([[80.0, 0, 29.5], [0, 84.0, 26.0], [0, 0, 1]])


def distorted(normalised, k1, k2, p1, p2, k3):
    """Pixel coordinates, centres at +0.5, of rays (…, 2) on the plane z = 1."""
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([K[0, 2] + K[0, 0] * u, K[1, 2] + K[1, 1] * v], axis=-1)


small = st.floats(-0.2, 0.2)
tangential = st.floats(-0.01, 0.01)


@settings(max_examples=40, deadline=None)
@given(k1=small, k2=small, p1=tangential, p2=tangential, k3=st.floats(-0.1, 0.1))
def test_each_pixel_is_taken_from_where_its_ray_hit_the_sensor(k1, k2, p1, p2, k3):
    coefficients = np.array([k1, k2, p1, p2, k3])
    lens = Lens(K, coefficients, WIDTH, HEIGHT)
    expected = distorted(rays(lens), *coefficients)
    if lens.is_pinhole:
        return
    x, y = lens._maps  # OpenCV counts pixel centres in whole numbers
    np.testing.assert_allclose(np.stack([x, y], axis=-1) + 0.5, expected, atol=1e-3)


def rays(lens):
    """Where the rays of the pinhole picture's pixel centres meet the plane z = 1, shape (H, W, 2)."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    homogeneous = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(lens.pinhole).T
    return homogeneous[..., :2]


def test_a_ramp_comes_out_as_its_own_coordinate():
    """A picture whose colour is its own coordinate shows where each ray had hit the sensor."""
    coefficients = np.array([-0.3, 0.1, 0.01, -0.01, 0.02])
    lens = Lens(K, coefficients, WIDTH, HEIGHT)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    found = lens.undistort(np.stack([2 * x, 4 * y, x], -1).astype(np.uint8))[..., :2] / [2.0, 4.0]
    expected = distorted(rays(lens), *coefficients)
    inside = lens.visible & (expected > 1).all(-1) & (expected < [WIDTH - 1, HEIGHT - 1]).all(-1)
    assert inside.mean() > 0.8
    assert np.abs(found - expected)[inside].max() < 0.27  # eight bits: a quarter of a pixel
    assert np.abs((found - expected)[inside].mean(axis=0)).max() < 0.03


def test_every_pixel_of_the_pinhole_picture_was_seen():
    for k1 in (-0.3, 0.3):
        lens = Lens(K, np.array([k1, 0, 0, 0, 0]), WIDTH, HEIGHT)
        assert lens.visible.mean() > 0.97


def test_transparent_colour_does_not_leak_into_the_rim():
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    pixels[10:30, 10:40] = (200, 100, 50, 255)  # black where transparent
    out = Lens(K, np.array([-0.2, 0, 0, 0, 0]), WIDTH, HEIGHT).undistort(pixels)
    rim = (out[..., 3] > 20) & (out[..., 3] < 235)
    assert rim.sum() > 20
    assert np.abs(out[rim][:, :3].astype(int) - [200, 100, 50]).max() <= 10


def test_no_distortion_changes_nothing():
    lens = read_lens({"fl_x": 80.0, "cx": 29.5, "cy": 26.0, "camera_model": "SIMPLE_PINHOLE"}, WIDTH, HEIGHT, "here")
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    assert lens.undistort(picture) is picture
    np.testing.assert_array_equal(lens.pinhole, [[80, 0, 29.5], [0, 80, 26], [0, 0, 1]])


def test_angles_give_focal_lengths():
    lens = read_lens({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 3}, WIDTH, HEIGHT, "here")
    np.testing.assert_allclose(lens.pinhole[0], [WIDTH / 2, 0, WIDTH / 2])
    np.testing.assert_allclose(lens.pinhole[1], [0, HEIGHT / 2 * math.sqrt(3), HEIGHT / 2])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"fl_x": 80, "camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE has no k1"),
        ({"fl_x": 80, "camera_model": "FOV"}, "camera_model is 'FOV'"),
        ({"fl_x": 80, "camera_model": ["OPENCV"]}, "camera_model is"),
        ({"fl_x": "80"}, "'fl_x' is '80'"),
        ({"camera_angle_x": 3.5}, "between 0 and π"),
        ({"fl_x": 80, "k1": math.inf}, "'k1' is inf"),
    ],
)
def test_a_lens_that_cannot_be(row, message):
    with pytest.raises(InputError, match=message):
        read_lens(row, WIDTH, HEIGHT, "here")
