"""The rasteriser against its plain-torch twin, finite differences and pictures whose answer is known."""

import dataclasses
import doctest
import math

import numpy as np
import pytest
import torch
from random_gaussians import BACKGROUND, make_camera, make_gaussians, weighted

from masiv.errors import InputError, MasivError
from masiv.scene.camera import Camera
from masiv.splat._reference import _render
from masiv.splat.rasteriser import render

pytestmark = pytest.mark.usefixtures("taichi")


@dataclasses.dataclass
class Twin:
    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor


@pytest.mark.parametrize(("seed", "skew"), [(0, 0.0), (1, 4.0)])
def test_same_picture_and_gradients_as_the_twin(seed, skew):
    camera = make_camera(skew=skew)
    gaussians = make_gaussians(seed=seed)
    ours = render(camera, *gaussians, BACKGROUND)
    twin = Twin(*_render(camera, *gaussians, BACKGROUND))
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(ours, name), getattr(twin, name), atol=1e-12, rtol=1e-10)
    gradients = torch.autograd.grad(weighted(ours), gaussians)
    expected = torch.autograd.grad(weighted(twin), gaussians)
    for one, other in zip(gradients, expected, strict=True):
        assert other.abs().max() > 1e-3
        torch.testing.assert_close(one, other, atol=1e-9 * float(other.abs().max()), rtol=1e-9)


def test_opaque_pixels_stop_early_as_the_twin_does():
    """Many opaque layers: the clip at 0.99 and the stop at T < 1e-4 both act."""
    camera = make_camera(16, 16)
    means, _, _, colours = make_gaussians(80)
    scales = torch.full((80,), 0.3, dtype=torch.float64, requires_grad=True)
    opacities = torch.linspace(0.6, 1.0, 80, dtype=torch.float64).requires_grad_()
    gaussians = [means, scales, opacities, colours]
    ours, twin = render(camera, *gaussians, BACKGROUND), Twin(*_render(camera, *gaussians, BACKGROUND))
    assert twin.alpha.min() > 0.998
    torch.testing.assert_close(ours.rgb, twin.rgb, atol=1e-12, rtol=1e-10)
    pairs = zip(
        torch.autograd.grad(weighted(ours), gaussians), torch.autograd.grad(weighted(twin), gaussians), strict=True
    )
    for one, other in pairs:
        torch.testing.assert_close(one, other, atol=1e-8 * float(other.abs().max()), rtol=1e-7)


def test_finite_differences():
    """Opacities well above the skip level and moderate cover, so that no threshold lies within the step."""
    camera = make_camera(20, 18)
    gaussians = [g.detach() for g in make_gaussians(6, seed=5)]
    gaussians[2] = gaussians[2] * 0.4 + 0.2
    for g in gaussians:
        g.requires_grad_()
    gradients = torch.autograd.grad(weighted(render(camera, *gaussians, BACKGROUND)), gaussians)
    rng = np.random.default_rng(0)
    # The skip at 1/255 makes the picture jump by up to 0.004 at isolated points: the median over directions is immune.
    for which, step in enumerate((1e-7, 1e-7, 1e-7, 1e-6)):
        errors = []
        for _ in range(5):
            direction = torch.tensor(rng.standard_normal(gaussians[which].shape))
            values = []
            for sign in (1, -1):
                moved = [g.detach().clone() for g in gaussians]
                moved[which] += sign * step * direction
                values.append(float(weighted(render(camera, *moved, BACKGROUND))))
            numeric = (values[0] - values[1]) / (2 * step)
            analytic = float((gradients[which] * direction).sum())
            errors.append(abs(numeric - analytic) / (abs(analytic) + 1e-3))
        assert np.median(errors) < 1e-4, (which, errors)


def test_float32_is_close_to_float64():
    camera = make_camera(64, 48)
    exact = make_gaussians(400, seed=2)
    rough = [g.detach().float().requires_grad_() for g in exact]
    one, other = render(camera, *rough, BACKGROUND.float()), render(camera, *exact, BACKGROUND)
    # A pixel at the skip level may fall on either side: 1/255 of a colour.
    assert (one.rgb - other.rgb).abs().mean() < 1e-5
    assert (one.rgb - other.rgb).abs().max() < 0.01


def test_one_gaussian_has_the_analytic_profile():
    """On the optical axis the variance is (f sigma / z)^2 + 0.3, and the peak is the opacity."""
    camera = Camera("axis", 41, 41, np.array([[80.0, 0, 20.5], [0, 80.0, 20.5], [0, 0, 1]]), np.eye(4))
    z, sigma, opacity = 2.0, 0.1, 0.7
    args = (
        torch.tensor([[0.0, 0.0, z]]),
        torch.tensor([sigma]),
        torch.tensor([opacity]),
        torch.tensor([[1.0, 0.5, 0.0]]),
    )
    picture = render(camera, *(a.double() for a in args), torch.zeros(3).double())
    variance = (80 * sigma / z) ** 2 + 0.3
    for dx, dy in [(0, 0), (3, 0), (0, -5), (4, 4)]:
        expected = opacity * math.exp(-(dx**2 + dy**2) / (2 * variance))
        assert float(picture.alpha[20 + dy, 20 + dx]) == pytest.approx(expected, rel=1e-6)
        assert float(picture.rgb[20 + dy, 20 + dx, 1]) == pytest.approx(0.5 * expected, rel=1e-6)
        assert float(picture.depth[20 + dy, 20 + dx]) == pytest.approx(z, rel=1e-9)


def test_crop_is_a_window_of_the_picture():
    camera = make_camera(60, 50)
    gaussians = [g.detach() for g in make_gaussians(100, seed=4)]
    whole = render(camera, *gaussians, BACKGROUND)
    part = render(camera.cropped(11, 7, 30, 26), *gaussians, BACKGROUND)
    torch.testing.assert_close(part.rgb, whole.rgb[7:33, 11:41], atol=1e-10, rtol=1e-8)


def test_nothing_to_draw():
    camera = make_camera()
    behind = torch.tensor([[0.0, 0.0, -50.0]], dtype=torch.float64, requires_grad=True)
    one = torch.ones(1, dtype=torch.float64)
    picture = render(camera, behind, 0.1 * one, one, torch.ones(1, 3, dtype=torch.float64), BACKGROUND)
    assert torch.equal(picture.rgb, BACKGROUND.expand(29, 37, 3))
    picture.rgb.sum().backward()
    assert torch.equal(behind.grad, torch.zeros_like(behind))


def test_repeats_to_the_bit():
    def run():
        gaussians = make_gaussians(500, seed=9, dtype=torch.float32)
        picture = render(make_camera(80, 70), *gaussians, BACKGROUND.float())
        weighted(picture).backward()
        return [picture.rgb.detach(), *(g.grad for g in gaussians)]

    first = run()
    for _ in range(3):
        assert all(torch.equal(a, b) for a, b in zip(first, run(), strict=True))


def test_non_finite_is_an_error():
    gaussians = [g.detach().clone() for g in make_gaussians(3)]
    gaussians[0][1, 2] = float("nan")
    with pytest.raises(MasivError, match="not finite"):
        render(make_camera(), *gaussians, BACKGROUND)


@pytest.mark.parametrize(
    ("which", "change", "message"),
    [
        (0, lambda t: t[:, :2], r"means has shape \(60, 2\), it must be \(60, 3\)"),
        (1, lambda t: t[:, None].expand(-1, 3), r"scales has shape \(60, 3\), it must be \(60,\)"),
        (2, lambda t: t[:-1], r"opacities has shape \(59,\), it must be \(60,\)"),
        (3, lambda t: t[:, 0], r"colours has shape \(60,\), it must be \(60, 3\)"),
        (4, lambda t: t[:2], r"background has shape \(2,\), it must be \(3,\)"),
        (1, lambda t: t.float(), "scales is torch.float32 and means torch.float64"),
        (0, lambda t: t.long(), "means is torch.int64"),
    ],
)
def test_a_wrong_shape_or_type_is_named(which, change, message):
    given = [*make_gaussians(), BACKGROUND]
    given[which] = change(given[which])
    with pytest.raises(InputError, match=message):
        render(make_camera(), *given)


def test_the_example_in_the_docstring_runs():
    (example,) = (test for test in doctest.DocTestFinder().find(render, "render") if test.examples)
    result = doctest.DocTestRunner().run(example)
    assert result.failed == 0
    assert result.attempted >= 9
