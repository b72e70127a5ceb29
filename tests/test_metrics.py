"""Metrics against analytic cases and a direct float64 twin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from masiv import metrics
from masiv.errors import InputError
from masiv.scene.scene import Ground

GRAVITY = np.array([0.0, -9.8, 0.0])


def test_chamfer_of_two_points_ten_millimetres_apart_is_a_fifth():
    assert metrics.chamfer_1e3mm2(np.zeros((1, 3)), np.array([[0.0, 0.01, 0.0]])) == pytest.approx(0.2)


def test_chamfer_sums_both_directions():
    near, far = np.zeros((1, 3)), np.array([[0.0, 0, 0], [0.02, 0, 0]])
    assert metrics.chamfer_1e3mm2(near, far) == pytest.approx(0.5 * 0.02**2 * 1e3)
    assert metrics.chamfer_1e3mm2(far, near) == metrics.chamfer_1e3mm2(near, far)


def test_chamfer_samples_at_most_max_points_and_repeats():
    points = np.random.default_rng(0).random((3000, 3))
    once = metrics.chamfer_1e3mm2(points, points, max_points=500, seed=3)
    assert once > 0  # different subsets of the two sets
    assert once == metrics.chamfer_1e3mm2(points, points, max_points=500, seed=3)
    assert metrics.chamfer_1e3mm2(points, points) == 0


def test_chamfer_floor_is_that_of_a_dense_sampling():
    """Mean squared distance to the nearest of n points a unit volume is Γ(5/3) (3 / 4πn)^(2/3)."""
    points = np.random.default_rng(1).random((20000, 3))
    expected = 2 * 0.9027 * (3 / (4 * np.pi * 20000)) ** (2 / 3) * 1e3
    assert metrics.chamfer_floor(points, max_points=10**6) == pytest.approx(expected, rel=0.08)


def test_chamfer_refuses_points_that_are_not_finite():
    with pytest.raises(InputError, match="not finite"):
        metrics.chamfer_1e3mm2(np.full((2, 3), np.nan), np.zeros((1, 3)))


def test_tracked_error_ignores_sampling_and_sees_a_shift():
    rng = np.random.default_rng(2)
    true_rest, rest = rng.random((800, 3)), rng.random((300, 3))
    velocity = np.array([1.0, 0.5, 0])
    times = np.arange(4) / 24
    truth = true_rest + times[:, None, None] * velocity
    moved = rest + times[:, None, None] * velocity
    np.testing.assert_allclose(metrics.tracked_error_mm(rest, moved, truth), 0, atol=1e-9)
    shifted = moved + np.array([0.0, 0, 0.004]) * (np.arange(4) > 1)[:, None, None]
    np.testing.assert_allclose(metrics.tracked_error_mm(rest, shifted, truth), [0, 0, 4, 4], atol=1e-9)


def test_tracked_error_interpolates_a_smooth_field():
    rng = np.random.default_rng(3)
    true_rest, rest = rng.random((6000, 3)), 0.2 + 0.6 * rng.random((200, 3))
    stretch = np.diag([0.2, -0.1, 0.0])
    truth = np.stack([true_rest, true_rest + true_rest @ stretch])
    moved = np.stack([rest, rest + rest @ stretch])
    assert metrics.tracked_error_mm(rest, moved, truth)[1] < 0.05 * 200


def test_psnr_of_a_known_error_and_scale():
    black = np.zeros((5, 6, 3), np.uint8)
    assert metrics.psnr(black, black) == float("inf")
    assert metrics.psnr(black + np.uint8(51), black) == pytest.approx(20 * np.log10(5))
    assert metrics.psnr(np.full((5, 6, 3), 0.2), black) == pytest.approx(20 * np.log10(5))


def pictures(rows, columns):
    """Two (34, 13, 1) that are black but for ``rows`` and ``columns``."""
    found = np.zeros((2, 34, 13, 1))
    content = found[:, rows, columns]
    content[:] = np.random.default_rng(4).random(content.shape)
    return found


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(None), slice(None)),
        (slice(20, 24), slice(None)),
        (slice(0, 3), slice(10, 13)),
        (slice(16, 17), slice(6, 7)),
    ],
)
def test_ssim_and_psnr_against_direct_sums(rows, columns):
    """Also where most of both pictures is black."""
    a, b = pictures(rows, columns)
    offsets = np.arange(-5, 6)
    kernel = np.exp(-(offsets**2) / (2 * 1.5**2))
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2

    def mean(picture):
        padded = np.pad(picture[..., 0], 5)
        return np.array([[(kernel * padded[i : i + 11, j : j + 11]).sum() for j in range(13)] for i in range(34)])

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert metrics.ssim(a, b) == pytest.approx(expected.mean(), abs=1e-12)
    assert metrics.ssim(a, a) == pytest.approx(1)
    assert metrics.psnr(a, b) == pytest.approx(-10 * np.log10(((a - b) ** 2).mean()))


def test_black_pictures_are_alike():
    black = np.zeros((4, 5, 3), np.uint8)
    assert metrics.ssim(black, black) == 1


def test_box_scores_look_only_at_the_mask():
    image = np.zeros((40, 40, 3), np.uint8)
    reference = image.copy()
    reference[:5, :5] = 255
    mask = np.zeros((40, 40))
    mask[20:30, 18:25] = 1
    scores = metrics.picture_scores(image, reference, mask)
    assert scores["psnr_box_db"] == float("inf")
    assert scores["psnr_db"] == pytest.approx(-10 * np.log10(25 / 1600))
    assert metrics.mask_box(mask, margin=0) == (slice(20, 30), slice(18, 25))
    assert metrics.mask_box(np.zeros((4, 4))) is None


def test_mask_iou():
    a, b = np.zeros((2, 4, 4))
    assert metrics.mask_iou(a, b) == 1
    a[:2], b[1:3] = 1, 1
    assert metrics.mask_iou(a, b) == pytest.approx(4 / 12)


def test_ballistic_flight_is_half_g_t_squared_and_turns_about_the_centre():
    points = np.random.default_rng(5).random((50, 3))
    times = np.array([0.0, 0.1, 0.4])
    velocity, omega, centre = np.array([1.0, 2, 0]), np.array([0.0, 0, np.pi]), points.mean(0)
    motion = metrics.rigid_ballistic(points, velocity, omega, centre, GRAVITY, times)
    np.testing.assert_allclose(motion[0], points)
    np.testing.assert_allclose(motion.mean(1), centre + times[:, None] * velocity + 0.5 * times[:, None] ** 2 * GRAVITY)
    turned = Rotation.from_euler("z", 0.4 * 180, degrees=True).apply(points - centre)
    np.testing.assert_allclose(motion[2] - motion[2].mean(0), turned, atol=1e-12)


def test_ballistic_flight_stops_at_the_ground():
    points = np.array([[0.0, 1.0, 0], [0, 1.5, 0]])
    ground = Ground(np.array([0.0, 1, 0]), 0.0)
    times = np.linspace(0, 1, 11)
    motion = metrics.rigid_ballistic(points, np.zeros(3), np.zeros(3), points.mean(0), GRAVITY, times, ground)
    contact = np.sqrt(2 / 9.8)
    before = times < contact
    np.testing.assert_allclose(motion[before][:, 0, 1], 1 - 4.9 * times[before] ** 2)
    np.testing.assert_allclose(motion[~before][:, 0, 1], 0, atol=1e-6)
    free = metrics.rigid_ballistic(points, np.zeros(3), np.zeros(3), points.mean(0), GRAVITY, times)
    assert free[-1, 0, 1] == pytest.approx(1 - 4.9)
