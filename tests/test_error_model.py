"""The error model: against dense normal densities, and on draws of what it assumes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_model import NOISE, ONES, TIMES, LinearModel, baseline, pattern
from scipy.stats import binom, chi2, multivariate_normal

from masiv.inference.error_covariance import ErrorBlock, matern52
from masiv.inference.error_model import ErrorModel
from masiv.inference.evidence import Evidence
from masiv.inference.marginal_likelihood import ParameterPriors, SizePriors, marginal, marginal_with_unknown
from masiv.inference.model_fit import evaluate_fit
from masiv.inference.predictive import forecast
from masiv.inference.segments import effective_instants, independent_series
from masiv.refinement.hypotheses import Linearizations, linearized, weighed
from masiv.refinement.posterior_fit import CLOSE, linearized_at_mean, posterior_fit

INSTANTS, STEP = 40, 0.1
LAGS = STEP * np.abs(np.subtract.outer(np.arange(INSTANTS), np.arange(INSTANTS)))
LOGS = np.log([1.5, 0.8, 0.4, 1.0, 0.6])
"""Of jitter, smooth errors, their length [s], the grid's change and its jitter."""


def block(residual, motion=1e3, weight=1.0):
    count = len(residual)
    return ErrorBlock(
        residual, np.zeros((*residual.shape, 0)), LAGS[:count, :count], 0, 1.0, np.linspace(1, 2, count),
        np.linspace(0, 1, count), 0.3, weight, motion, grid_jitter=np.linspace(0, 2, count) ** 2,
    )  # fmt: skip


def smooth(rng, length, size, modes=3):
    """Draws (T, K) of a smooth process with a correlation time ``length`` [s]."""
    covariance = matern52(LAGS / length) + 1e-9 * np.eye(INSTANTS)
    return size * np.linalg.cholesky(covariance) @ rng.normal(size=(INSTANTS, modes))


NO_PARAMETERS = ParameterPriors(np.zeros(0), np.zeros((1, 0)))


# -- the model of errors of known sizes -------------------------------------------------------------------------------


def test_density_is_that_of_a_dense_normal_density_to_the_power_of_the_weight():
    residual = np.random.default_rng(0).normal(size=(INSTANTS, 2))
    model = ErrorModel((block(residual, weight=0.7),), LOGS)
    dense = multivariate_normal(np.zeros(INSTANTS), model.covariances[0])
    assert model.logpdf([residual]) == pytest.approx(0.7 * sum(dense.logpdf(c) for c in residual.T))


def test_whitened_draws_are_white_and_as_dependent_as_the_weight_says():
    rng = np.random.default_rng(1)
    model = ErrorModel((block(np.zeros((INSTANTS, 3)), weight=1 / 3),), LOGS)
    drawn = np.stack([model.draw(rng)[0] for _ in range(3000)])
    white = np.stack([model.whiten([d])[0] for d in drawn])
    series = white.transpose(0, 2, 1).reshape(-1, INSTANTS)
    np.testing.assert_allclose(np.cov(series.T), np.eye(INSTANTS), atol=0.12)
    assert np.linalg.matrix_rank(drawn[0], tol=1e-9) == 1


def test_density_of_all_is_that_of_the_past_and_of_the_future_given_it():
    residual, split = np.random.default_rng(2).normal(size=(INSTANTS, 2)), 25
    model = ErrorModel((block(residual),), LOGS)
    ((mean, covariance),) = model.conditional([residual[:split]])
    past = multivariate_normal(np.zeros(split), model.covariances[0][:split, :split])
    later = sum(multivariate_normal(m, covariance).logpdf(r) for m, r in zip(mean.T, residual[split:].T, strict=True))
    assert later + sum(past.logpdf(c) for c in residual[:split].T) == pytest.approx(model.logpdf([residual]))


def test_without_a_past_the_future_is_as_beforehand():
    model = ErrorModel((block(np.zeros((INSTANTS, 2))),), LOGS)
    ((mean, covariance),) = model.conditional([np.zeros((0, 2))])
    np.testing.assert_array_equal(mean, np.zeros((INSTANTS, 2)))
    np.testing.assert_allclose(covariance, model.covariances[0])


def test_whitened_residuals_of_null_data_are_white():
    """Portmanteau test (Ljung & Box 1978) of residuals that are whitened with the sizes that were found in them."""
    rng, lags, p = np.random.default_rng(3), 6, []
    for _ in range(60):
        length, size = np.exp(rng.uniform(np.log(2 * STEP), np.log(INSTANTS * STEP / 2))), rng.uniform(0, 3)
        residual = rng.normal(size=(INSTANTS, 3)) + smooth(rng, length, size)
        blocks = [block(residual)]
        found = marginal(blocks, NO_PARAMETERS, SizePriors.of(blocks))
        (white,) = ErrorModel(tuple(blocks), found.logs).whiten([residual])
        for series in white.T:
            centred = series - series.mean()
            correlation = [float(centred[k:] @ centred[:-k] / (centred @ centred)) for k in range(1, lags + 1)]
            statistic = INSTANTS * (INSTANTS + 2) * sum(c**2 / (INSTANTS - k) for k, c in enumerate(correlation, 1))
            p.append(chi2.sf(statistic, lags))
    assert np.sum(np.array(p) < 0.05) <= binom.ppf(0.999, len(p), 0.05)
    assert 0.35 < np.mean(np.array(p) < 0.5) < 0.65


# -- series that are not independent ----------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [None, 0.3, 0.8])
def test_independent_series_are_counted_although_they_are_smooth(length):
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(1, 3))
    apart, together = [], []
    for _ in range(100):
        series = rng.normal(size=(INSTANTS, 3)) if length is None else smooth(rng, length, 1.0)
        apart.append(independent_series(series, effective_instants(series)))
        one = series[:, :1] @ direction
        together.append(independent_series(one, effective_instants(one)))
    assert np.mean(apart) > 2.7
    assert np.mean(together) < 1.3


def test_effective_instants_are_those_of_the_correlation():
    rng, length = np.random.default_rng(5), 0.4
    true = INSTANTS**2 / (matern52(LAGS / length) ** 2).sum()
    found = [effective_instants(smooth(rng, length, 1.0, modes=60)) for _ in range(20)]
    assert np.mean(found) == pytest.approx(true, rel=0.1)
    assert effective_instants(np.zeros((7, 2))) == 7


# -- something unknown ------------------------------------------------------------------------------------------------


def unknown_of(residual):
    blocks = [block(residual)]
    known = SizePriors.of(blocks)
    return marginal_with_unknown(blocks, NO_PARAMETERS, known, known.with_unknown(blocks)).unknown


def test_errors_as_expected_are_nothing_unknown_and_larger_smooth_ones_are():
    rng = np.random.default_rng(6)
    jitter = lambda: rng.normal(size=(INSTANTS, 3))  # noqa: E731
    null = [unknown_of(jitter() + smooth(rng, 1.0, rng.uniform(0, 3))) for _ in range(20)]
    assert max(null) < 0.5
    moved = [unknown_of(jitter() + smooth(rng, 1.0, 60.0)) for _ in range(10)]
    assert min(moved) > 0.5


# -- predictions and values -------------------------------------------------------------------------------------------


def with_test(model, count):
    (own,) = model.observations
    return model.with_observations([replace(own, test_count=count)])


@pytest.mark.slow
def test_what_is_expected_of_the_test_is_found_there():
    found, expected = [], []
    for seed in range(8):
        model = with_test(LinearModel({"velocity_z": 0.3}, seed=seed), 6)
        line = linearized(model, baseline(model))
        evidence = Evidence.of(model.observations, line.fields)
        told = forecast(evidence, line, [], evidence.marginal(line, []))
        found.append(told.found_mm)
        expected.append(told.expected_mm)
    ratio = np.sqrt(np.mean(np.square(found)) / np.mean(np.square(expected)))
    assert ratio == pytest.approx(1.0, abs=0.15)


def test_without_a_test_nothing_is_said_of_it():
    model = LinearModel({"velocity_z": 0.3})
    line = linearized(model, baseline(model))
    evidence = Evidence.of(model.observations, line.fields)
    assert forecast(evidence, line, [], evidence.marginal(line, [])) is None


class Drifting(LinearModel):
    """All points together have smooth errors, ten times as large as their mean jitter."""

    def __init__(self, truth, seed):
        super().__init__(truth, seed=seed)
        (own,) = self.observations
        drift = smooth(np.random.default_rng([seed, 1]), 0.5, 10 * NOISE / np.sqrt(30))
        values = own.values + drift[:, None]
        self.observations = (replace(own, values=values),)


@pytest.mark.slow
def test_values_of_the_posterior_are_nearer_to_the_truth_than_those_of_least_squares():
    squares, moved = [], []
    for seed in range(10):
        model = Drifting({"velocity_z": 0.3}, seed)
        fit = baseline(model)
        again = posterior_fit(model, fit, 1.0)
        assert again.validation_mm <= fit.validation_mm
        squares.append((fit.values["velocity_z"] - 0.3) ** 2)
        moved.append((again.values["velocity_z"] - 0.3) ** 2)
    assert np.mean(moved) < np.mean(squares)


def test_a_fit_at_the_mean_of_its_posterior_stays_there():
    model = LinearModel({"velocity_z": 0.3})
    again = posterior_fit(model, baseline(model), 1.0)
    (hypothesis,) = weighed(model, [(again, linearized(model, again))])
    assert hypothesis.distance_from_mean <= CLOSE
    assert posterior_fit(model, again, 1.0).values == again.values


def test_standard_errors_hold_how_far_a_fit_is_from_the_mean_of_its_posterior():
    model = LinearModel({"velocity_z": 0.3})
    at_mean = posterior_fit(model, baseline(model), 1.0)
    moved = {"velocity_z": at_mean.values["velocity_z"] + 0.05}
    off = evaluate_fit(model, at_mean.model, at_mean.parameters, moved, at_mean.jacobian, robust_scale=1.0)
    (hypothesis,) = weighed(model, [(off, linearized(model, off))])
    assert hypothesis.with_posterior().stderr["velocity_z"] == pytest.approx(
        np.hypot(0.05, at_mean.stderr["velocity_z"]), rel=0.01
    )


class Turning(LinearModel):
    """The points go back and forth the faster, the larger the velocity is: not linear."""

    def motion(self, values):
        return super().motion(values) + 0.1 * pattern(1, np.sin(8 * values.get("velocity_z", 0.0) * TIMES), ONES)


def test_a_model_is_weighed_alike_wherever_its_fit_ended():
    model = Turning({"velocity_z": 0.3})
    best = posterior_fit(model, baseline(model), 1.0)
    evidence = Evidence.of(model.observations, best.fields)
    own, at_mean = [], []
    for off in (0.0, 0.1, -0.1):
        values = {"velocity_z": best.values["velocity_z"] + off}
        fit = evaluate_fit(model, best.model, best.parameters, values, best.jacobian, robust_scale=1.0)
        lines = linearized(model, fit), linearized_at_mean(model, fit, evidence, 1.0, Linearizations())
        found = [weighed(model, [(fit, line)], evidence=evidence)[0] for line in lines]
        own.append(found[0].marginal.log_evidence)
        at_mean.append(found[1].marginal.log_evidence)
        # It is as far from its posterior as it was moved, whatever it is linearised about.
        assert found[1].with_posterior().stderr["velocity_z"] == pytest.approx(
            np.hypot(off, best.stderr["velocity_z"]), rel=0.05
        )
    assert np.ptp(own) > 10
    assert np.ptp(at_mean) < 0.1


def test_fits_that_are_asked_for_twice_are_linearised_once_and_in_order():
    model = LinearModel({"velocity_z": 0.3})
    one, other = baseline(model), baseline(model, ("viscosity",))
    known = Linearizations()
    lines = list(known.each(model, [one, one, other, one]))
    assert [line.values for line in lines] == [f.values for f in (one, one, other, one)]
    assert lines[0] is lines[1] is lines[3]
    assert known.of(model, other) is lines[2]
    near = list(known.nearly(model, [(other, lines[0]), (other, lines[0])]))
    assert near[0] is near[1]
    np.testing.assert_allclose(near[0].jacobians[0], lines[2].jacobians[0])  # it is linear
