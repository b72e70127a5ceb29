"""Modes of motion, and the marginal likelihood: against dense normal densities, and on draws of what it assumes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from masiv.inference.error_covariance import BlockCovariance, ErrorBlock, matern52
from masiv.inference.marginal_likelihood import ParameterPriors, SizePriors, _Likelihood, marginal
from masiv.inference.motion_modes import MotionModes, rotations_since_start
from masiv.inference.segments import jitter_of, jitter_of_grids


@pytest.fixture
def points():
    return np.random.default_rng(0).normal(size=(60, 3)) * [0.3, 0.2, 0.1] + [1.0, 2.0, 3.0]


def test_modes_are_orthonormal_and_hold_polynomials_of_second_degree(points):
    modes = MotionModes.of(points, 3)
    assert modes.names == ("translation", "rotation", "strain", "quadratic")
    basis = np.concatenate(modes.bases, axis=1)
    np.testing.assert_allclose(basis.T @ basis, np.eye(30), atol=1e-9)
    x, y, z = (points - points.mean(0)).T
    field = np.stack([x * y + 0.3 * x, y**2 - z, np.ones_like(x)], axis=1)[None]
    found = modes.coefficients(field)
    assert sum((c**2).sum() for c in found) == pytest.approx((field**2).sum(2).mean(), rel=1e-9)


def test_rotation_of_a_turned_body_is_a_rotation_and_a_shift_stays_a_shift(points):
    modes = MotionModes.of(points, 3)
    start = points - points.mean(0)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    now = start @ turn.T
    turned = rotations_since_start(points, now[None])
    np.testing.assert_allclose(turned[0], turn, atol=1e-9)
    spin = np.cross([0.3, -0.2, 0.5], now)
    shift, rotation, *rest = modes.coefficients((spin + np.eye(3)[0])[None], turned)
    np.testing.assert_allclose(shift[0], [1.0, 0.0, 0.0], atol=1e-9)
    assert (rotation**2).sum() == pytest.approx((spin**2).sum(1).mean())
    assert max(np.abs(c).max() for c in rest) < 1e-9


def test_points_on_a_line_and_one_point_have_fewer_modes():
    line = np.zeros((5, 3))
    line[:, 0] = np.arange(5.0)
    modes = MotionModes.of(line, 3)
    basis = np.concatenate(modes.bases, axis=1)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
    assert modes.bases[modes.names.index("rotation")].shape[1] == 2  # none about the line
    assert MotionModes.of(np.zeros((1, 3)), 2).names == ("translation",)


def block(rng, instants=9, modes=2, count=3, sizes=(1.0, 2.0), weight=1.0):
    times = np.arange(instants) * 0.1
    return ErrorBlock(
        rng.normal(size=(instants, modes)), rng.normal(size=(instants, modes, count)),
        np.abs(np.subtract.outer(times, times)), 0, sizes[0], np.linspace(1, 2, instants) * sizes[1],
        np.linspace(0, 1, instants), 0.3, weight, grid_jitter=np.linspace(0, 2, instants) ** 2,
    )  # fmt: skip


def test_marginal_likelihood_is_that_of_a_dense_normal_density():
    rng = np.random.default_rng(1)
    b = block(rng)
    priors = ParameterPriors(np.array([0.0, -0.5, 0.2]), np.array([[0.1, 1.0, 4.0], [0.1, 0.2, 0.3]]))
    logs = np.array([0.2, -0.3, np.log(0.25), 0.1, -0.4])
    terms = _Likelihood([b], priors, SizePriors.of([b])).terms(logs)
    values = np.exp(logs)
    c = (values[0] * b.jitter) ** 2 * np.eye(9)
    c += values[1] ** 2 * np.outer(b.smooth, b.smooth) * matern52(b.lags / values[2])
    c += values[3] ** 2 * np.outer(b.grid, b.grid) * matern52(b.lags / b.grid_length)
    c += values[4] ** 2 * np.diag(b.grid_jitter) ** 2
    np.testing.assert_allclose(BlockCovariance(b)(logs), c, rtol=1e-7)
    dense = np.kron(c, np.eye(2))
    j, r = b.jacobian.reshape(18, 3), b.residual.reshape(18) + b.jacobian.reshape(18, 3) @ priors.mean
    for k in range(2):
        whole = dense + j @ np.diag(1 / priors.precision[k]) @ j.T
        assert float(terms.logp[k]) == pytest.approx(multivariate_normal.logpdf(r, np.zeros(18), whole), rel=1e-6)
        gain = np.diag(1 / priors.precision[k]) @ j.T @ np.linalg.inv(whole)
        np.testing.assert_allclose(terms.mean[k], -gain @ r, atol=1e-6)
        posterior = np.diag(1 / priors.precision[k]) - gain @ j @ np.diag(1 / priors.precision[k])
        np.testing.assert_allclose(terms.covariance[k], posterior, atol=1e-6)


def test_a_strength_that_cannot_be_negative_has_the_mass_above_zero():
    rng = np.random.default_rng(2)
    b = block(rng, count=1)
    free, half = (ParameterPriors(np.array([0.3]), np.array([[0.5]]), p) for p in ((), (0,)))
    whole, part = (_Likelihood([b], p, SizePriors.of([b])).terms(np.zeros(5)) for p in (free, half))
    above = norm.sf(0.0, whole.mean[0, 0], whole.covariance[0, 0, 0] ** 0.5)
    assert part.logp[0] - whole.logp[0] == pytest.approx(np.log(2 * above))


def test_of_several_strengths_that_cannot_be_negative_one_may_be_near_zero():
    # The first is far above zero, the second below: their probability of being positive is that of the second one.
    rng = np.random.default_rng(2)
    slope = block(rng).jacobian
    b = replace(block(rng), residual=-(slope[..., 1] * 3 - slope[..., 2] * 0.4), jacobian=slope)
    free, half = (ParameterPriors(np.zeros(3), np.array([[0.1, 1e-4, 1e-3]]), p) for p in ((), (1, 2)))
    whole, part = (_Likelihood([b], p, SizePriors.of([b])).terms(np.zeros(5)) for p in (free, half))
    mean, covariance = whole.mean[0, 1:], whole.covariance[0, 1:, 1:]
    assert mean[0] > 4 * covariance[0, 0] ** 0.5
    assert -4 * covariance[1, 1] ** 0.5 < mean[1] < 0
    both = multivariate_normal.cdf(mean, np.zeros(2), covariance)
    assert part.logp[0] - whole.logp[0] == pytest.approx(np.log(4 * both), abs=0.02)


@pytest.mark.parametrize("positive", [(), (1,), (1, 2)])
def test_gradient_by_the_sizes_is_that_of_finite_differences(positive):
    rng = np.random.default_rng(3)
    blocks = [block(rng), block(rng, modes=4, sizes=(0.5, 1.0), weight=0.3)]
    precision = np.array([[0.1, 1.0, 4.0], [0.1, 0.2, 0.3]])
    likelihood = _Likelihood(
        blocks, ParameterPriors(np.array([0.0, -0.5, 0.2]), precision, positive), SizePriors.of(blocks)
    )
    at = np.array([0.2, -0.3, -1.0, 0.4, -0.2])
    _, gradient = likelihood.objective(at)
    for k in range(5):
        step = 1e-5 * np.eye(5)[k]
        slope = (likelihood.objective(at + step)[0] - likelihood.objective(at - step)[0]) / 2e-5
        assert gradient[k] == pytest.approx(slope, rel=1e-6)


def test_matern_correlation_falls_from_one():
    rho = matern52(np.linspace(0, 5, 50))
    assert rho[0] == 1
    assert (np.diff(rho) < 0).all()
    assert rho[-1] < 1e-3


def test_jitter_is_seen_under_a_smooth_motion():
    t = np.linspace(0, 1, 60)[:, None]
    smooth = np.concatenate([0.05 * np.sin(5 * t), 0.1 * t**2], axis=1)
    noise = np.random.default_rng(0).normal(0, 1e-3, smooth.shape)
    assert jitter_of(smooth + noise) == pytest.approx(1e-3, rel=0.25)
    assert jitter_of(smooth[:5]) == 0.0


def test_what_grids_change_from_instant_to_instant_is_seen_where_it_is():
    """Two grids differ smoothly from the start, and from instant 30 on by independent values as well."""
    rng = np.random.default_rng(4)
    apart = 1e-2 * np.sin(np.linspace(0, 2, 60))[:, None] * np.ones(40)
    apart[30:] += 1e-3 * rng.normal(size=(30, 40))
    found = jitter_of_grids(np.stack([apart, -apart]))
    assert (found[:27] < 1e-5).all()
    # A third grid is off the mean of two by the square root of three times as much as they are.
    np.testing.assert_allclose(found[34:], np.sqrt(3) * 1e-3, rtol=0.35)
    np.testing.assert_array_equal(jitter_of_grids(np.zeros((0, 60, 40))), np.zeros(60))


def drawn(rng, slope, instants=40):
    """A straight line with ``slope``, of which place and speed are unknown, with an effect that bends it; jitter and
    smooth errors."""
    times = np.linspace(0, 1, instants)
    lags = np.abs(np.subtract.outer(times, times))
    size, length = rng.uniform(0, 3), np.exp(rng.uniform(np.log(0.05), 0.0))
    smooth = np.linalg.cholesky(np.exp(-0.5 * (lags / length) ** 2) + 1e-9 * np.eye(instants)) @ rng.normal(
        size=instants
    )
    columns = np.stack([np.ones(instants), times, times**2], axis=1)[:, None]
    residual = (rng.normal(size=instants) + size * smooth)[:, None] - slope * columns[..., 2]
    return ErrorBlock(residual, columns, lags, 0, 1.0, np.ones(instants), np.zeros(instants), 0.3)


SCALES = np.geomspace(0.3, 300, 5)


def judged(b):
    """log Bayes factor for the effect, its mean and standard deviation."""
    flat = [1e-6, 1e-6]
    without = ErrorBlock(b.residual, b.jacobian[..., :2], b.lags, 0, b.jitter, b.smooth, b.grid, b.grid_length)
    sizes = SizePriors.of([b])
    null = marginal([without], ParameterPriors(np.zeros(2), np.array([flat])), sizes)
    effect = marginal([b], ParameterPriors(np.zeros(3), np.array([[*flat, s**-2] for s in SCALES])), sizes)
    return effect.log_evidence - null.log_evidence, effect.mean[2], effect.covariance[2, 2] ** 0.5


def test_nothing_is_named_without_an_effect_and_intervals_cover_with_one():
    """A small edition of benchmarks/calibration.md: equal odds, so that a factor of 19 is 5 %."""
    rng = np.random.default_rng(5)
    factors = [judged(drawn(rng, 0.0))[0] for _ in range(60)]
    assert sum(f > np.log(19) for f in factors) <= 6  # P(more than 6 of 60 at 5 %) = 3 %
    found = [(s, *judged(drawn(rng, s))[1:]) for s in rng.choice([-1, 1], 60) * np.exp(rng.uniform(1, 4, 60))]
    z = np.array([(mean - s) / sd for s, mean, sd in found])
    assert 30 <= (np.abs(z) < 1).sum() <= 54  # 41 expected
    assert (np.abs(z) < 2).sum() >= 51  # 57 expected


def test_what_grids_differ_by_along_a_parameter_adds_its_variance_and_no_evidence():
    """Two grids that differ like a parameter by +a and -a: one more lies sqrt(3) a from their mean, whatever the
    noise is."""
    b = drawn(np.random.default_rng(3), 5.0)
    priors = ParameterPriors(np.zeros(3), np.full((1, 3), 1e-9))
    without = marginal([b], priors, SizePriors.of([b]))
    shift = 0.7 * b.jacobian[..., 2]
    found = marginal([replace(b, grids=np.stack([shift, -shift]))], priors, SizePriors.of([b]))
    np.testing.assert_allclose(found.covariance - without.covariance, np.diag([0, 0, 3 * 0.7**2]), atol=1e-4)
    assert found.log_evidence == without.log_evidence
