"""Parts of refine on models that are known in closed form, without a simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_refine import VELOCITY
from test_workers import small_simulation

from masiv.errors import MasivError
from masiv.inference.discretization import with_grid_errors, with_residual_std
from masiv.inference.model_fit import ModelFit, best_strength, column, gauss_newton_jump, strengths_alone
from masiv.models.base import EffectTerm, Model, WeightedResidual
from masiv.models.families import FAMILIES
from masiv.models.free_body import FreeBodyModel
from masiv.models.parameters import Parameter
from masiv.refine import second_effect
from masiv.refine.add_effect import absent
from masiv.refine.candidates import score
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import (
    explains_too_little,
    log_predictive_gain,
    objections,
    reduced_chi,
    sigmas_from_zero,
    simplest,
)
from masiv.refine.search import could_improve

INSTANTS, ROWS, POINTS = 6, 4, 5
NOISE = 1e-3


@dataclass(frozen=True)
class Observation(WeightedResidual):
    noise_std: float = NOISE
    residual_std: np.ndarray = None
    time_count: int = INSTANTS
    fit_count: int = ROWS
    holds_out: bool = True
    grid_corrections: tuple[np.ndarray, ...] = ()


class Linear:
    """residual = matrix @ values - target; finer grids make ``changes``."""

    def __init__(self, matrix, target, *changes):
        self.matrix, self.target, self.changes = matrix, target, changes
        self.observations = (Observation(residual_std=np.full(INSTANTS, NOISE)),)

    def residual(self, model, values):
        return self.matrix @ np.array([values["a"], values["b"]]) - self.target

    def finer_grids(self, model, values, index):
        return list(self.changes)


def parameters():
    return [Parameter("a", 0.0, -100.0, 100.0, 1e-3), Parameter("b", 0.0, -100.0, 2.0, 1e-3)]


def test_a_leap_ends_in_the_minimum_however_far_and_within_bounds():
    random = np.random.default_rng(0)
    matrix = random.normal(size=(30, 2))
    for truth, found in (([40.0, -7.0], [40.0, -7.0]), ([3.0, 50.0], None)):
        simulation = Linear(matrix, matrix @ np.array(truth))
        start = {"a": 0.0, "b": 0.0}
        values, residual, jacobian = gauss_newton_jump(
            simulation, None, parameters(), start, simulation.residual(None, start), matrix, robust_scale=1e6
        )
        np.testing.assert_allclose(residual, simulation.residual(None, values))
        if found is not None:
            assert [values["a"], values["b"]] == pytest.approx(found, rel=1e-2)
            np.testing.assert_allclose(jacobian, matrix, atol=1e-9)  # it was exact, and stays so
        else:
            assert values["b"] == 2.0


def test_strengths_are_found_with_the_rest_as_it_is():
    matrix = np.random.default_rng(1).normal(size=(30, 2))
    simulation = Linear(matrix, matrix @ np.array([5.0, 1.5]))
    values = strengths_alone(simulation, None, {"a": 5.0, "b": -30.0}, parameters()[1:], robust_scale=1e6)
    assert values["a"] == 5.0
    assert values["b"] == pytest.approx(1.5, rel=2e-3)


def test_a_strength_whose_effect_begins_late_is_found_by_trying():
    class Kinked(Linear):  # below 3 the effect does nothing
        def residual(self, model, values):
            return np.full(6, max(values["b"] - 3.0, 0.0) - 5.0)

    strengths = [Parameter("b", 0.0, 0.0, 20.0, 1e-3)]
    values, cost = best_strength(Kinked(np.eye(2), 0.0), None, {"a": 1.0, "b": 2.0}, strengths, robust_scale=1e6)
    assert values == {"a": 1.0, "b": 8.0}
    assert cost == pytest.approx(0.0, abs=1e-9)


def test_an_effect_begins_with_what_stood_for_it():
    height = Parameter("ground_height.height", 0.0, -0.3, 0.3, 1e-3)
    names = ("ground_offset@a", "ground_offset@b")
    term = EffectTerm("ground_height", "ground_height", (height,), (), ((),), {}, replaces_parameter=names)
    start = absent(term, {"ground_offset@a": 0.02, "ground_offset@b": 0.03, "velocity_x@a": 1.0})
    assert start == {"ground_height.height": 0.025, **dict.fromkeys(names, 0.0), "velocity_x@a": 1.0}
    plain = EffectTerm("linear_drag", "linear_drag", (replace(height, name="linear_drag.rate"),), (), ((),), {})
    assert absent(plain, {"velocity_x@a": 1.0}) == {"linear_drag.rate": 0.0, "velocity_x@a": 1.0}


def test_what_a_fit_absorbs_or_all_grids_change_is_no_uncertainty():
    random = np.random.default_rng(2)
    jacobian = random.normal(size=(ROWS * POINTS * 3, 2))
    shape = (INSTANTS, POINTS, 3)
    absorbed = np.zeros(shape)
    absorbed[:ROWS] = 1e-2 * (jacobian @ np.array([1.0, -2.0])).reshape(ROWS, POINTS, 3)
    sizes = np.sqrt((absorbed[:ROWS] ** 2).sum(2).mean(1))
    assert (sizes > 10 * NOISE).all()
    fitted = SimpleNamespace(jacobian=jacobian, model=None, values={}, parameters=parameters())

    def found(*changes, fitted=fitted):
        (observation,) = with_residual_std(Linear(jacobian, 0.0, *changes), fitted, [np.full(INSTANTS, NOISE)])
        return observation

    np.testing.assert_allclose(found(absorbed, 2 * absorbed).residual_std, NOISE, rtol=1e-6)
    common, apart = 3e-2 * random.normal(size=shape), 1e-2 * random.normal(size=shape)
    alike = found(common, 1.2 * common + absorbed)
    np.testing.assert_allclose(alike.residual_std, NOISE, rtol=1e-6)
    np.testing.assert_array_equal(alike.grid_corrections, [common, 1.2 * common + absorbed])
    differing = found(common + apart, common - apart)
    rms = np.sqrt((apart**2).sum(2).mean(1))
    # A third grid is off the mean of two by the square root of three times as much as they are.
    assert (np.sqrt(differing.residual_std**2 - NOISE**2)[:ROWS] >= 0.8 * np.sqrt(3) * rms[:ROWS]).all()
    assert (differing.residual_std <= 3 * np.maximum.accumulate(rms) + NOISE).all()
    assert (np.diff(differing.residual_std) >= 0).all()
    # What an earlier mean had absorbed does not count.
    columns = np.concatenate([apart[:ROWS].reshape(-1, 1), jacobian], axis=1)
    share = Parameter("grid_change@0", 0.0, -1.0, 3.0, 0.25)
    again = SimpleNamespace(jacobian=columns, model=None, values={}, parameters=[share, *parameters()])
    np.testing.assert_array_equal(
        found(common + apart, common - apart, fitted=again).residual_std, differing.residual_std
    )
    assert found().grid_corrections == ()
    np.testing.assert_array_equal(found().residual_std, NOISE)


def test_standard_errors_hold_what_one_more_grid_would_move():
    random = np.random.default_rng(3)
    jacobian = random.normal(size=(ROWS * POINTS * 3, 2))
    common, apart = np.zeros((2, INSTANTS, POINTS, 3))
    common[:ROWS] = 1e-2 * random.normal(size=(ROWS, POINTS, 3))
    apart[:ROWS] = 1e-2 * (jacobian @ np.array([3.0, -0.5])).reshape(ROWS, POINTS, 3)
    simulation = Linear(jacobian, 0.0)
    share = Parameter("grid_change@0", 0.0, -1.0, 3.0, 0.25)
    values = {share.name: 0.7, "a": 1.0, "b": 2.0}
    columns = np.concatenate([common[:ROWS].reshape(-1, 1), jacobian], axis=1)
    params = [share, parameters()[0], Parameter("b", 1.0, 0.1, 9.0, 1e-3, log=True)]
    errors = dict(zip(values, (0.1, 0.01, 0.02), strict=True))
    fitted = ModelFit(None, values, tuple(params), np.zeros(len(jacobian)), columns, 1.0, 9, 1.0, 1.0, [], errors)
    assert with_grid_errors(simulation, fitted, 1.0) is fitted  # no grid is known to change anything
    changes = (common + apart, common - apart)
    simulation.observations = (replace(simulation.observations[0], grid_corrections=changes),)
    found = with_grid_errors(simulation, fitted, 1.0).stderr
    # The mean's own size is what its share is for; a third grid is off it by the square root of three times as much.
    assert found[share.name] == pytest.approx(errors[share.name])
    assert found["a"] == pytest.approx(np.hypot(0.01, np.sqrt(3) * 1e-2 * 3.0))
    assert found["b"] == pytest.approx(np.hypot(0.02, np.sqrt(3) * 1e-2 * 0.5 * values["b"]))


def fits(*levels, count=3):
    """As fitted: mean square distances, in units of the noise, over fitted and held-out instants."""
    squares = NOISE**2 * np.repeat(np.array(levels, dtype=float), [ROWS, INSTANTS - ROWS])
    return SimpleNamespace(squares=[squares], parameters=[None] * count, values=dict.fromkeys(range(count)))


def judged(before, after, residual_std=NOISE, adapts=True, sure=None):
    observations = [Observation(residual_std=np.full(INSTANTS, residual_std))]
    return explains_too_little(before, after, observations, RefineConfig(), adapts=adapts, sure=lambda: sure)


def test_evidence():
    assert judged(fits(9, 9), fits(1, 1)) == []
    assert "of what noise" in judged(fits(1.6, 1.6), fits(1.0, 1.5))[0]  # less than noise
    assert "held-out" in judged(fits(9, 20), fits(6, 22))[0]  # held-out instants contradict
    assert judged(fits(9, 20), fits(2, 20)) == []  # they cannot tell, the fitted ones are plain
    assert judged(fits(9, 20), fits(2, 17)) == []  # nor does a little in favour (8 %) count against it
    assert "held-out" in judged(fits(9, 20), fits(2, 22))[0]
    assert "held-out" in judged(fits(9, 20), fits(6, 20))[0]  # not plain enough for that
    # Plain beside a noise as smooth as what is left; not where held-out instants contradict, nor for next to nothing.
    assert judged(fits(9, 20), fits(6, 20), sure=7.0) == []
    assert "held-out" in judged(fits(9, 20), fits(6, 20), sure=5.0)[0]
    assert "held-out" in judged(fits(9, 20), fits(6, 22), sure=7.0)[0]
    assert "held-out" in judged(fits(1.9, 20), fits(1, 20), sure=7.0)[-1]
    assert judged(fits(2, 20), fits(1.5, 3)) == []  # they are decisive
    # The less the fitted instants say, the more the held-out ones must: half of what noise could change, a third of 20.
    assert judged(fits(1.6, 20), fits(1.1, 8)) == []
    assert "asked: 32 %" in judged(fits(1.6, 20), fits(1.1, 10))[-1]
    # What has a strength and nothing else may explain less, but not against what is held out.
    little = fits(1.6, 2.0), fits(1.2, 1.2)
    assert "of what noise" in judged(*little)[0]
    assert judged(*little, adapts=False) == []
    assert "held-out" in judged(fits(1.6, 2.0), fits(1.4, 1.3), adapts=False)[-1]  # the less, the more held-out again
    assert judged(fits(2.6, 2.0), fits(1.4, 1.3), adapts=False) == []
    assert "held-out" in judged(fits(1.6, 2.0), fits(1.2, 2.0), adapts=False)[-1]
    # Nothing is plain where the simulation is nowhere as certain as the observation.
    assert "held-out" in judged(fits(36, 80), fits(8, 80), residual_std=2 * NOISE)[0]


def test_held_out_instants_are_one_sample_of_the_criterion():
    observations = [Observation(residual_std=np.full(INSTANTS, NOISE))]
    assert log_predictive_gain(fits(2, 6), fits(1, 2), observations) == pytest.approx(math.log(3))
    assert log_predictive_gain(fits(2, 6), fits(1, 0.1), observations) == pytest.approx(
        math.log(6)
    )  # noise alone is not foretold
    assert log_predictive_gain(fits(2, 2), fits(1, 6), observations) == pytest.approx(-math.log(3))
    assert log_predictive_gain(fits(2, 6), fits(1, 2), [replace(observations[0], holds_out=False)]) == 0.0
    rate = Parameter("linear_drag.rate", 0.1, 0.0, 10.0, 0.1)
    term = EffectTerm("linear_drag", "linear_drag", (rate,), (), ((),), {})

    def objected(gain, was, now):
        before, after = fits(9, was), fits(1, now)
        for found, criterion in ((before, 0.0), (after, -gain)):
            found.bic, found.samples, found.jacobian = lambda samples, c=criterion: c, 100, np.ones((4, 1))
            found.parameters, found.values, found.stderr = [rate], {rate.name: 1.0}, {rate.name: 0.1}
        return " ".join(objections(before, after, term, observations, RefineConfig.model_validate({})))

    assert objected(5.4, 6, 2) == ""
    assert "falls by 5.5, less than 6" in objected(5.4, 2.2, 2)
    assert "falls by 5.9, less than 6" in objected(7.0, 2, 6)


def test_a_second_cause_is_confirmed_and_both_are_certain():
    rate = Parameter("linear_drag.rate", 0.1, 0.0, 10.0, 0.1)
    term = EffectTerm("linear_drag", "linear_drag", (rate,), (), ((),), {})
    simulation = SimpleNamespace(
        term=lambda name: term,
        objections=lambda *_: [],
        observations=[Observation(residual_std=np.full(INSTANTS, NOISE))],
    )

    def pair(gain, held_out, sigmas=5.0):
        found = fits(1.0, held_out)
        found.model, found.samples, found.jacobian = SimpleNamespace(effects=("linear_drag",)), 100, np.ones((4, 1))
        found.parameters, found.values, found.stderr = [rate], {rate.name: 1.0}, {rate.name: 1.0 / sigmas}
        found.bic = lambda samples: -gain
        return found

    def objected(gain, was, now, **more):
        config = RefineConfig.model_validate({})
        return " ".join(second_effect.objections(simulation, pair(0.0, was), pair(gain, now, **more), config))

    assert objected(15, 4.0, 1.8) == ""  # held-out frames confirm it
    assert "asked: 30 %" in objected(15, 4.0, 2.5)
    assert objected(25, 4.0, 2.5) == ""  # less will do where the criterion is clear
    assert "asked: 15 %" in objected(99, 2.0, 2.0)
    assert "-22 % of the held-out" in objected(99, 2.0, 3.0)
    assert "less than 6" in objected(5, 4.0, 2.0)
    assert "2.0 standard errors" in objected(25, 4.0, 2.0, sigmas=2.0)


def test_a_strength_counts_with_its_place_held():
    random = np.random.default_rng(4)
    along, throw, apart = random.normal(size=(3, 40))
    strength, place = (Parameter(f"mass.{n}", 0.0, -9.0, 9.0, 1e-3) for n in ("size", "x"))
    other = Parameter("throw", 0.0, -9.0, 9.0, 1e-3)
    term = SimpleNamespace(strengths=(strength,), others=(place,))
    # The place does nearly what the strength does: its standard error alone is large.
    jacobian = np.stack([throw, along, along + 0.1 * apart], axis=1)
    stderr = 0.2 * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    names = ("throw", strength.name, place.name)
    fitted = SimpleNamespace(
        jacobian=jacobian, parameters=(other, strength, place),
        values=dict.fromkeys(names, 0.5), stderr=dict(zip(names, stderr, strict=True)),
    )  # fmt: skip
    alone = 0.2 * np.sqrt(np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])[1, 1])
    assert 0.5 / stderr[1] < 4
    assert sigmas_from_zero(fitted, term) == pytest.approx(0.5 / alone, rel=1e-6)


def test_of_causes_that_explain_as_much_thesimplest():
    observations = [Observation(residual_std=np.full(INSTANTS, NOISE))]
    rich, plain, poor = (fits(1.0, 1, count=9), fits(1.1, 1, count=4), fits(3, 1, count=2))
    assert simplest([rich, plain, poor], observations) is plain
    assert simplest([], observations) is None
    uncertain = [replace(observations[0], residual_std=np.full(INSTANTS, 10 * NOISE))]
    assert simplest([rich, plain, poor], uncertain) is poor
    assert reduced_chi(fits(9, 1), observations) == pytest.approx(3.0)


def test_a_worse_law_is_not_fitted_with_what_would_not_make_up_for_it():
    base = SimpleNamespace(cost=2.0)
    trials = [SimpleNamespace(fitted=SimpleNamespace(cost=c)) for c in (1.5, 1.8)]
    assert could_improve(SimpleNamespace(explained=0.2), base, trials)
    assert not could_improve(SimpleNamespace(explained=0.1), base, trials)
    assert could_improve(SimpleNamespace(explained=0.1), base, [])


def test_a_body_that_ends_somewhere_else_is_followed_from_where_that_shows():
    @dataclass(frozen=True)
    class Throw:
        problem: SimpleNamespace
        fitted: int = 12
        flight: int = 3

        @property
        def fit_count(self):
            return (self.fitted - 1) * self.problem.samples

    simulation = FreeBodyModel([Throw(SimpleNamespace(size=0.5, samples=2))])
    near = np.full(30, 1e-6)
    assert simulation.curriculum(SimpleNamespace(squares=[near])) == []
    away = np.where(np.arange(30) < 12, near, 0.2**2)  # at the end of frame 6, all is well
    assert [s.observations[0].fitted for s in simulation.curriculum(SimpleNamespace(squares=[away]))] == [9, 10]
    # A fit that gives up the flight for what comes after it shows at once, which is no sign of when that was.
    everywhere = np.full(30, 0.2**2)
    for flight, horizons in ((3, [6, 9]), (6, [9, 10])):
        simulation = FreeBodyModel([replace(simulation.observations[0], flight=flight)])
        assert [
            s.observations[0].fitted for s in simulation.curriculum(SimpleNamespace(squares=[everywhere]))
        ] == horizons


@pytest.mark.usefixtures("taichi")
def test_first_moments_begin_with_the_throw_of_free_flight():
    simulation, _ = small_simulation()
    reset_initial_conditions = simulation.reset_initial_conditions(
        {"youngs_modulus": 1e4, "velocity_x@run": 9.0, "linear_drag.rate": 0.5}
    )
    assert reset_initial_conditions.pop("velocity_x@run") == pytest.approx(VELOCITY[0], abs=0.3)  # drag acts, too
    assert reset_initial_conditions == {"youngs_modulus": 1e4, "linear_drag.rate": 0.5}


@pytest.mark.usefixtures("taichi")
def test_a_law_that_few_particles_can_take_finer_grids_can_take_too():
    (observation,) = small_simulation()[0].observations

    def law(modulus):
        return SimpleNamespace(wave_modulus=lambda: modulus)

    def possible(modulus):
        try:
            return observation.problem.min_substeps(law(modulus)) > 0
        except MasivError:
            return False

    stiffest = max(filter(possible, np.geomspace(1e3, 1e8, 200)))
    needed = [finer.least_substeps(law(stiffest)) for finer in observation.finer]
    assert max(needed) > observation.problem.simulator.max_substeps_per_frame


@pytest.mark.usefixtures("taichi")
def test_a_model_has_a_share_of_what_finer_grids_change():
    simulation, _ = small_simulation()
    model = Model(FAMILIES["neo_hookean"], "sticky")
    values = {p.name: p.start for p in simulation.parameters(model)}
    (without,) = simulation.fields(model, values)
    change = np.random.default_rng(0).normal(size=(simulation.observations[0].time_count, *without.shape[1:]))
    simulation.observations = (replace(simulation.observations[0], grid_corrections=(0.9 * change, 1.1 * change)),)
    share = simulation.parameters(model)[0]
    assert (share.name, share.start) == ("grid_change@run", 0.0)
    rolled = simulation.rollouts
    residual = simulation.residual(model, values)
    derivative = column(simulation, model, {**values, share.name: 0.0}, residual, share)
    assert simulation.rollouts == rolled  # nothing else moves
    expected = simulation.observations[0].whiten(change[: len(without)]).ravel()
    np.testing.assert_allclose(derivative, expected, rtol=1e-9, atol=1e-12)
    (whole,) = simulation.fields(model, {**values, share.name: 0.5}, held_out=True)
    np.testing.assert_allclose(whole[: len(without)], without + 0.5 * change[: len(without)], atol=1e-12)


def test_an_effect_that_sets_in_late_is_ranked_by_what_it_does_when_it_has():
    shape = np.random.default_rng(0).normal(size=40)

    class Kinked:
        """Nothing below a slipperiness of 1, more and more above it; 5 is true."""

        def is_out_of_phase(self, base):
            return False

        def term(self, name):
            return EffectTerm(name, name, (Parameter("a", 0.0, 0.0, 100.0, 0.5),), (), ((),), {}, nonsmooth=True)

        def residual(self, model, values):
            return shape * (max(values["a"] - 1.0, 0.0) - 4.0)

    base = SimpleNamespace(
        residual=-4.0 * shape, jacobian=np.ones((40, 1)), parameters=parameters()[:1], values={"a": 0.0}, samples=40,
        model=SimpleNamespace(effects=(), with_effect=lambda name: None),
    )  # fmt: skip
    (found,) = score(Kinked(), base, robust_scale=1e6, names=["slide"])
    assert found.explained == pytest.approx(1.0, abs=1e-6)
    assert 3.0 < found.theta["a"] < 9.0


@pytest.mark.usefixtures("taichi")
def test_a_copy_with_other_observations_leaves_the_simulation_as_it_was():
    simulation, _ = small_simulation()
    model = Model(FAMILIES["neo_hookean"], "sticky")
    values = {p.name: p.start for p in simulation.parameters(model)}
    residual = simulation.residual(model, values)
    (observation,) = simulation.observations
    copy = simulation.with_observations([replace(observation, residual_std=2 * observation.residual_std)])
    rolled = simulation.rollouts
    np.testing.assert_allclose(copy.residual(model, values), 0.5 * residual)
    assert copy.rollouts == simulation.rollouts == rolled  # the rollout was known
    copy.residual(model, {**values, "youngs_modulus": 1.1 * values["youngs_modulus"]})
    assert copy.rollouts == simulation.rollouts == rolled + 1
    assert simulation.observations == (observation,)
    np.testing.assert_array_equal(simulation.residual(model, values), residual)
