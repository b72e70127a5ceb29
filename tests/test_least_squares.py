"""Least squares by finite differences, on problems whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from masiv.errors import MasivError, NonFiniteError
from masiv.inference.least_squares import broyden, derivative, gauss_newton, gauss_newton_jump, linearize
from masiv.inference.robust import soft_l1_mean_square, soft_l1_sum
from masiv.models.parameters import Parameter

TIMES = np.linspace(0, 2, 200)


def test_linear_regression_and_its_covariance():
    design = np.stack([np.ones_like(TIMES), TIMES, TIMES**2], axis=1)
    truth = np.array([0.3, -2.0, 0.7])
    noise = np.random.default_rng(0).normal(0, 0.1, len(TIMES))
    parameters = [Parameter(name, 0.0, -10, 10, 0.01) for name in "abc"]
    found = gauss_newton(
        lambda v: design @ [v["a"], v["b"], v["c"]] - design @ truth - noise, parameters, max_evaluations=200
    )
    exact, squares, *_ = np.linalg.lstsq(design, design @ truth + noise, rcond=None)
    assert np.allclose([found.values[n] for n in "abc"], exact, atol=2e-5)
    covariance = np.linalg.inv(design.T @ design) * squares[0] / (len(TIMES) - 3)
    assert np.allclose(found.covariance, covariance, rtol=1e-3)
    errors = found.stderr(len(TIMES))
    assert np.allclose([errors[n] for n in "abc"], np.sqrt(np.diag(covariance)), rtol=1e-3)
    assert np.allclose(found.jacobian, design, atol=1e-8)


def test_repeated_residuals_tell_no_more():
    noise = np.random.default_rng(1).normal(0, 0.1, 50)
    parameter = [Parameter("mean", 0.0, -5, 5, 0.01)]
    once = gauss_newton(lambda v: v["mean"] - noise, parameter, max_evaluations=50)
    often = gauss_newton(lambda v: np.repeat(v["mean"] - noise, 20), parameter, max_evaluations=50)
    assert math.isclose(often.stderr(50)["mean"], once.stderr(50)["mean"], rel_tol=1e-6)
    assert often.stderr(1000)["mean"] < 0.3 * once.stderr(50)["mean"]
    assert often.stderr(1)["mean"] == math.inf


def test_logarithmic_parameter_over_orders_of_magnitude():
    def residual(v):
        return 2 * np.exp(-v["rate"] * TIMES) + 0.1 - (2 * np.exp(-3.0 * TIMES) + 0.1)

    found = gauss_newton(residual, [Parameter("rate", 0.05, 1e-3, 1e3, 0.02, log=True)], max_evaluations=60)
    assert math.isclose(found.values["rate"], 3.0, rel_tol=1e-4)


def test_logarithmic_standard_error_is_in_the_unit_of_the_value():
    noise = np.random.default_rng(2).normal(0, 0.05, len(TIMES))
    for log in (True, False):
        parameter = [Parameter("slope", 1.0, 0.1, 100, 1e-3, log=log)]
        found = gauss_newton(lambda v: v["slope"] * TIMES - 5 * TIMES - noise, parameter, max_evaluations=60)
        assert math.isclose(found.stderr(200)["slope"], 0.05 / np.linalg.norm(TIMES), rel_tol=0.15)


def test_bounds_hold_and_the_other_parameter_makes_up():
    seen = []

    def residual(v):
        seen.append(v["a"])
        return np.array([v["a"] - 3.0, v["a"] + v["b"] - 5.0])

    found = gauss_newton(
        residual, [Parameter("a", 0.0, -1, 1, 0.05), Parameter("b", 0.0, -10, 10, 0.05)], max_evaluations=300
    )
    assert max(seen) <= 1
    assert math.isclose(found.values["a"], 1.0, abs_tol=0.02)
    assert math.isclose(found.values["b"], 5 - found.values["a"], abs_tol=0.02)


def test_a_step_that_diverges_is_refused():
    refused = []

    def residual(v):
        if v["x"] > 2:  # where a full Gauss-Newton step would land
            refused.append(v["x"])
            raise NonFiniteError(3, 4, "too fast")
        return np.array([10 * (v["x"] ** 2 - 1.9**2), 0.01])

    found = gauss_newton(residual, [Parameter("x", 0.05, 1e-6, 50, 0.02)], max_evaluations=100)
    assert refused
    assert math.isclose(found.values["x"], 1.9, rel_tol=1e-3)


def test_a_start_that_diverges_is_an_error():
    def residual(v):
        raise NonFiniteError(0, 0, "too fast")

    with pytest.raises(NonFiniteError):
        gauss_newton(residual, [Parameter("x", 1.0, 0, 2, 0.1)], max_evaluations=10)
    with pytest.raises(NonFiniteError):
        gauss_newton(lambda v: np.array([np.nan]), [Parameter("x", 1.0, 0, 2, 0.1)], max_evaluations=10)


def test_divergence_on_both_sides_is_an_error_that_names_the_parameter():
    def residual(v):
        if v["x"] != 1.0:
            raise NonFiniteError(0, 0, "too fast")
        return np.ones(2)

    with pytest.raises(MasivError, match="both sides of x"):
        gauss_newton(residual, [Parameter("x", 1.0, 0, 2, 0.1)], max_evaluations=10)


def test_evaluations_are_counted_and_kept_to():
    calls = []

    def residual(v):
        calls.append(v)
        return np.array([10 * (v["y"] - v["x"] ** 2), 1 - v["x"]])  # Rosenbrock

    parameters = [Parameter("x", -1.2, -5, 5, 1e-3), Parameter("y", 1.0, -5, 5, 1e-3)]
    for budget in (3, 10, 25):
        calls.clear()
        found = gauss_newton(residual, parameters, max_evaluations=budget)
        assert found.evaluations == len(calls) <= budget
        assert float(found.residual @ found.residual) <= 24.2
    calls.clear()
    found = gauss_newton(residual, parameters, max_evaluations=4000)
    assert math.isclose(found.values["x"], 1, abs_tol=1e-2)
    assert math.isclose(found.values["y"], 1, abs_tol=2e-2)


def test_a_parameter_that_nothing_depends_on_has_infinite_error():
    parameters = [Parameter("a", 0.0, -5, 5, 0.1), Parameter("b", 0.0, -5, 5, 0.1)]
    found = gauss_newton(lambda v: v["a"] - np.array([1.0, 1.2, 0.9, 1.0]), parameters, max_evaluations=50)
    errors = found.stderr(4)
    assert errors["b"] == math.inf
    assert 0 < errors["a"] < 0.2
    both = gauss_newton(lambda v: v["a"] + v["b"] - np.array([1.0, 1.2, 0.9]), parameters, max_evaluations=50)
    assert min(both.stderr(3).values()) > 1e3


def test_robust_fit_ignores_wild_residuals():
    noise = np.random.default_rng(3).normal(0, 0.05, len(TIMES))
    noise[::20] += 5.0
    parameter = [Parameter("slope", 1.0, 0.0, 10, 0.01)]
    plain = gauss_newton(lambda v: v["slope"] * TIMES - 2 * TIMES - noise, parameter, max_evaluations=100)
    robust = gauss_newton(lambda v: v["slope"] * TIMES - 2 * TIMES - noise, parameter, max_evaluations=100, robust=True)
    assert abs(robust.values["slope"] - 2) < 0.5 * abs(plain.values["slope"] - 2)
    assert robust.stderr(200)["slope"] < plain.stderr(200)["slope"]


def test_the_same_call_gives_the_same_bits():
    noise = np.random.default_rng(4).normal(0, 0.05, len(TIMES))
    parameters = [Parameter("a", 1.0, 0.1, 10, 0.01, log=True), Parameter("b", 0.0, -1, 1, 0.01)]

    def run():
        return gauss_newton(
            lambda v: v["a"] * np.sin(TIMES) + v["b"] - 2 * np.sin(TIMES) - noise, parameters, max_evaluations=60
        )

    first, second = run(), run()
    assert first.values == second.values
    assert np.array_equal(first.covariance, second.covariance)


# -- with a Jacobian that is known -----------------------------------------------------------------------------------


def linear_problem(matrix, truth):
    """Residual of a linear model, and its parameters a and b, b at most 2."""
    target = matrix @ np.array(truth)
    bounds = [Parameter("a", 0.0, -100.0, 100.0, 1e-3), Parameter("b", 0.0, -100.0, 2.0, 1e-3)]
    return (lambda v: matrix @ np.array([v["a"], v["b"]]) - target), bounds


@pytest.mark.parametrize(("truth", "reached"), [([40.0, -7.0], [40.0, -7.0]), ([3.0, 50.0], None)])
def test_a_jump_ends_in_the_minimum_however_far_and_within_bounds(truth, reached):
    matrix = np.random.default_rng(0).normal(size=(30, 2))
    residual, parameters = linear_problem(matrix, truth)
    start = linearize(residual, parameters, {"a": 0.0, "b": 0.0})
    np.testing.assert_allclose(start.jacobian, matrix, atol=1e-9)
    here = gauss_newton_jump(residual, parameters, start, robust_scale=1e6)
    np.testing.assert_allclose(here.residual, residual(here.values))
    if reached is None:
        assert here.values["b"] == 2.0
    else:
        assert [here.values["a"], here.values["b"]] == pytest.approx(reached, rel=1e-2)
        np.testing.assert_allclose(here.jacobian, matrix, atol=1e-9)  # it was exact, and stays so


def test_broyden_reaches_a_minimum_with_a_jacobian_that_was_wrong():
    matrix = np.random.default_rng(2).normal(size=(30, 2))
    residual, parameters = linear_problem(matrix, [0.02, -0.015])
    start = linearize(residual, parameters, {"a": 0.0, "b": 0.0})
    wrong = replace(start, jacobian=start.jacobian @ np.array([[1.0, 0.6], [0.2, 1.4]]))
    calls = []

    def counted(values):
        calls.append(values)
        return residual(values)

    here = broyden(counted, parameters, wrong, steps=12, robust_scale=1.0)
    assert len(calls) <= 12
    assert np.linalg.norm(here.residual) < 1e-2 * np.linalg.norm(start.residual)
    np.testing.assert_allclose(here.residual, residual(here.values))


def test_broyden_goes_round_what_diverges():
    matrix = np.random.default_rng(3).normal(size=(30, 2))
    residual, parameters = linear_problem(matrix, [0.006, 0.0])

    def bounded(values):
        if values["a"] > 0.007:
            raise NonFiniteError(0, 0, "too fast")
        return residual(values)

    start = linearize(residual, parameters, {"a": 0.0, "b": 0.0})
    too_flat = replace(start, jacobian=0.5 * start.jacobian)  # its first step goes twice as far as it should
    here = broyden(bounded, parameters, too_flat, steps=12, robust_scale=1.0)
    assert here.values["a"] == pytest.approx(0.006, rel=0.05)


def test_a_derivative_that_diverges_on_both_sides_is_an_error():
    def residual(values):
        if values["x"] != 1.0:
            raise NonFiniteError(0, 0, "too fast")
        return np.ones(2)

    with pytest.raises(NonFiniteError, match="both sides of x"):
        derivative(residual, {"x": 1.0}, np.ones(2), Parameter("x", 1.0, 0, 2, 0.1))


def test_the_two_robust_costs_differ_in_scale_alone():
    residual = np.random.default_rng(5).normal(0, 2e-3, 50)
    for scale in (1e-3, 1e-2):
        per_sample = soft_l1_sum(residual, scale) / len(residual)
        assert soft_l1_mean_square(residual, scale) == pytest.approx(2 * scale**2 * per_sample)
    assert soft_l1_mean_square(residual, 1.0) == pytest.approx(float((residual**2).mean()), rel=1e-4)
    assert soft_l1_sum(residual, math.inf) == pytest.approx(float(residual @ residual))


class Jumping:
    """The square of x, one more from x = 1 on: as a simulation that takes more substeps there."""

    def __init__(self, at=None):
        self.at = at

    def __call__(self, values):
        x = values["x"]
        return np.array([x**2 - 4.0 + ((x if self.at is None else self.at) >= 1.0)])

    def held_at(self, values):
        return Jumping(values["x"])


def test_a_jump_is_not_mistaken_for_a_derivative():
    x = Parameter("x", 0.99, -10, 10, 0.02)
    residual = Jumping()
    here = residual({"x": 0.99})
    assert derivative(residual, {"x": 0.99}, here, x) == pytest.approx([2 * 0.99 + 0.02])
    assert derivative(Jumping().__call__, {"x": 0.99}, here, x) == pytest.approx([2 * 0.99 + 0.02 + 50])
    found = gauss_newton(residual, [x], max_evaluations=100)
    assert found.values["x"] == pytest.approx(math.sqrt(3.0), abs=1e-3)
    only = gauss_newton(residual, [x], max_evaluations=2)
    assert only.jacobian == pytest.approx(np.array([[2 * 0.99 + 0.02]]))
