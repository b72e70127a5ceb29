"""Are the probabilities of refine right? A small edition of benchmarks/refine_calibration.py, and its parts."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta, binom, kstest, norm

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import calibration_draws as draws
import calibration_table as statistics
import modal_body
from refine_calibration import probability_below, row_of

from masiv.inference.evidence import Evidence, strength_scales
from masiv.inference.marginal_likelihood import SizePriors
from masiv.inference.model_fit import gauss_newton_fit
from masiv.models.base import effect_parameters
from masiv.refinement.hypotheses import linearized

FIRST, DRAWS = 900_000, 36
"""Seeds that played no part in any choice."""


# -- draws ------------------------------------------------------------------------------------------------------------


def test_a_mode_obeys_its_equation_of_motion():
    times = np.linspace(0, 0.5, 5001)
    square, rate, force = np.array([400.0, 90.0]), np.array([3.0, 25.0]), np.array([2.0, -1.0])  # the second creeps
    q = modal_body.oscillator(times, np.array([0.1, -0.05]), rate, square, force)
    step = times[1]
    speed, acceleration = (q[2:] - q[:-2]) / (2 * step), (q[2:] - 2 * q[1:-1] + q[:-2]) / step**2
    left = acceleration + rate * speed + square * q[1:-1] - force
    assert np.abs(left).max() < 1e-3 * np.abs(acceleration).max()
    assert q[0] == pytest.approx([0.1, -0.05])
    assert np.abs(q[1] - q[0]).max() < 1e-5  # from rest


def test_strengths_are_those_of_the_prior():
    (drag,) = effect_parameters("quadratic_drag")
    rng = np.random.default_rng(3)
    drawn = [draws.strengths(rng, [drag], narrow=False)[drag.name] for _ in range(2000)]
    scales = strength_scales(drag)

    def mixture(x):
        """Half-normal components below their bound."""
        parts = [(2 * norm.cdf(x / s) - 1) / (2 * norm.cdf(drag.upper / s) - 1) for s in scales]
        kept = 2 * norm.cdf(drag.upper / scales) - 1  # the scale is drawn again, too
        return kept @ np.array(parts) / kept.sum()

    assert kstest(drawn, mixture).pvalue > 1e-3
    narrow = [draws.strengths(rng, [drag], narrow=True)[drag.name] / drag.step for _ in range(300)]
    assert draws.NARROW[0] <= min(narrow) < 0.5 < 20 < max(narrow) <= draws.NARROW[1]


def test_errors_are_jitter_and_up_to_three_times_as_large_smooth_ones():
    rng = np.random.default_rng(4)
    times, points = np.arange(40) / 60, rng.uniform(0, 0.3, (5, 3))
    squares = np.mean([(draws.errors(rng, points, times, 2e-3, 0.3) ** 2).mean() for _ in range(400)])
    assert squares == pytest.approx(2e-3**2 * (1 + draws.MAX_SMOOTH**2 / 3), rel=0.1)


@pytest.mark.parametrize("source", ["flights", "linear"])
def test_a_draw_is_what_its_seed_says(source, taichi):
    one, other = (draws.draw(source, 5, null_fraction=0.0) for _ in range(2))
    np.testing.assert_array_equal(one.forward_model.observations[0].values, other.forward_model.observations[0].values)
    assert one.truth == other.truth
    assert one.effect in one.forward_model.candidates(one.baselines[0].model)
    assert draws.draw(source, 5, null_fraction=1.0).effect is None


# -- statistics -------------------------------------------------------------------------------------------------------


def test_interval_of_a_share_is_that_of_clopper_and_pearson():
    low, high = statistics.interval(8, 20)
    assert binom.sf(7, 20, low) == pytest.approx(0.025)
    assert binom.cdf(8, 20, high) == pytest.approx(0.025)
    assert statistics.interval(0, 10) == (0.0, pytest.approx(1 - 0.025**0.1))


def test_reliability_of_probabilities_that_come_true():
    rng = np.random.default_rng(5)
    stated = rng.uniform(size=4000)
    for low, high, mean, count, total in statistics.reliability(stated, rng.uniform(size=4000) < stated):
        assert low <= mean <= high
        assert beta.ppf(1e-4, count, total - count + 1) < mean < beta.ppf(1 - 1e-4, count + 1, total - count)


def test_a_statement_is_for_as_many_draws_without_effect_as_there_are():
    row = {"null": 0.5, "null_fraction": 2 / 3, "sets": {"none": 0.5, "a": 0.4, "b": 0.1}}
    assert statistics.effect_probability(row) == pytest.approx(0.5)
    assert statistics.named_probability(row, "a") == pytest.approx(0.4)
    half = {**row, "null_fraction": 0.5}  # odds of an effect are twice those that refine takes for granted
    assert statistics.effect_probability(half) == pytest.approx(2 / 3)
    assert statistics.named_probability(half, "a") == pytest.approx(0.8 / 1.5)


def test_probability_below_goes_with_the_mean_and_from_none_to_all(taichi):
    given = draws.draw("flights", 2, null_fraction=0.0, narrow=True)
    model, base = given.forward_model, given.baselines[0]
    term = model.term("quadratic_drag")
    fit = gauss_newton_fit(model, base.model.with_effect(term.name), base.values, budget=40)
    line = linearized(model, fit)
    evidence = Evidence.of(model.observations, line.fields)
    index = [[p.name for p in line.parameters].index(term.strengths[0].name)]
    at, found = line.values[term.strengths[0].name], evidence.marginal(line, [term])
    ends = [probability_below(evidence, line, term, index, np.array([x - at]))[0] for x in (0.0, 3.0)]
    assert ends == pytest.approx([0.0, 1.0], abs=1e-6)  # a drag is positive
    assert SizePriors.of(evidence.blocks(line)).mean.shape == found.logs.shape


# -- the benchmark, small ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_probabilities_of_flights_come_true(taichi):
    """Bounds that a calibrated search would break once in a thousand times."""
    rows = [row_of("flights", 2 / 3, False, seed) for seed in range(FIRST, FIRST + DRAWS)]
    null, acting = [r for r in rows if r["effect"] is None], [r for r in rows if r["effect"] is not None]
    assert sum(bool(r["named"]) for r in null) <= binom.ppf(0.999, len(null), 0.05)
    known = [r for r in acting if r["posterior"] and r["effect"] != "periodic_force"]  # of a frequency that is seen
    central = [abs(statistics.below(r) - 0.5) < statistics.TWO / 2 for r in known]
    assert sum(central) >= binom.ppf(1e-3, len(known), statistics.TWO)
    obvious = [r for r in known if statistics.size(r) > 30 * np.linalg.norm(r["posterior"]["sd"])]
    assert obvious
    assert all(statistics.named_truth(r) for r in obvious)
    for _, _, mean, count, total in statistics.reliability(*statistics.statements(rows)["an effect acts"]):
        assert statistics.interval(count, total)[0] - 0.1 <= mean <= statistics.interval(count, total)[1] + 0.1
