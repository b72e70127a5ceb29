"""Video: what a copy of the simulation shares, where it starts, and what finer grids change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_refine import VELOCITY
from test_workers import small_simulation

from masiv.errors import MasivError
from masiv.inference.least_squares import derivative
from masiv.inference.model_fit import residual_of
from masiv.models.families import FAMILIES
from masiv.models.free_body import Model, Simulation


def test_a_body_that_ends_somewhere_else_is_followed_from_where_that_shows():
    @dataclass(frozen=True)
    class Throw:
        problem: SimpleNamespace
        fitted: int = 12
        flight: int = 3

        @property
        def fit_count(self):
            return (self.fitted - 1) * self.problem.samples

    simulation = Simulation([Throw(SimpleNamespace(size=0.5, samples=2))])
    near = np.full(30, 1e-6)
    assert simulation.curriculum(SimpleNamespace(squares=[near])) == []
    away = np.where(np.arange(30) < 12, near, 0.2**2)  # at the end of frame 6, all is well
    assert [s.observations[0].fitted for s in simulation.curriculum(SimpleNamespace(squares=[away]))] == [9, 10]
    # A fit that gives up the flight for what comes after it shows at once, which is no sign of when that was.
    everywhere = np.full(30, 0.2**2)
    for flight, horizons in ((3, [6, 9]), (6, [9, 10])):
        simulation = Simulation([replace(simulation.observations[0], flight=flight)])
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
            return observation.problem.least_substeps(law(modulus)) > 0
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
    simulation.observations = (replace(simulation.observations[0], grid_changes=(0.9 * change, 1.1 * change)),)
    share = simulation.parameters(model)[0]
    assert (share.name, share.start) == ("grid_change@run", 0.0)
    rolled = simulation.rollouts
    residual = simulation.residual(model, values)
    slope = derivative(residual_of(simulation, model), {**values, share.name: 0.0}, residual, share)
    assert simulation.rollouts == rolled  # nothing else moves
    expected = simulation.observations[0].whiten(change[: len(without)]).ravel()
    np.testing.assert_allclose(slope, expected, rtol=1e-9, atol=1e-12)
    (whole,) = simulation.fields(model, {**values, share.name: 0.5}, held_out=True)
    np.testing.assert_allclose(whole[: len(without)], without + 0.5 * change[: len(without)], atol=1e-12)


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
