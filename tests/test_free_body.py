"""The model of a filmed body: what its copies share, where it starts, what finer grids change."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from flight import VELOCITY, small_simulation
from scipy.optimize import brentq

from masiv.effects.catalogue import effect_named
from masiv.errors import MasivError, NonFiniteError
from masiv.inference.least_squares import derivative
from masiv.inference.model_fit import residual_of
from masiv.materials.classical import ClassicalLaw
from masiv.models.base import Model
from masiv.models.families import FAMILIES, law_of
from masiv.models.free_body import FreeBodyModel
from masiv.mpm.design import HELD_MARGIN


@pytest.mark.usefixtures("taichi")
def test_a_body_that_ends_somewhere_else_is_followed_from_where_that_shows():
    (setup,) = small_simulation()[0].setups
    count = 30
    observation = replace(
        setup.observation, times=np.arange(count) / 24, values=np.zeros((count, 1, 3), np.float32),
        points=np.zeros((1, 3)), residual_std=np.ones(count), observation_std=np.ones(count),
        samples_per_frame=2, fit_count=22,
    )  # fmt: skip

    def horizons(errors, flight):
        """Frames that are fitted in the shorter models, for errors (T,) in sizes of the body."""
        body = copy.copy(setup.body)
        body.samples = 2
        model = FreeBodyModel([replace(setup, observation=observation, body=body, flight=flight)])
        field = np.zeros((count, 1, 3))
        field[:, 0, 0] = errors * body.size
        return [shorter.observations[0].fit_frames for shorter in model.curriculum([field])]

    near = np.full(count, 2e-3)
    assert horizons(near, 3) == []
    away = np.where(np.arange(count) < 12, near, 0.4)  # at the end of frame 6, all is well
    assert horizons(away, 3) == [8, 9]
    # A fit that gives up the flight for what comes after it is wrong at once, which is no sign of when that was.
    everywhere = np.full(count, 0.4)
    assert horizons(everywhere, 3) == [5, 8]
    assert horizons(everywhere, 6) == [8, 9]


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
    (setup,) = small_simulation()[0].setups

    def law(modulus):
        return SimpleNamespace(wave_modulus=lambda: modulus)

    def possible(modulus):
        try:
            return setup.body.min_substeps(law(modulus)) > 0
        except MasivError:
            return False

    stiffest = max(filter(possible, np.geomspace(1e3, 1e8, 200)))
    needed = [finer.min_substeps(law(stiffest)) for finer in setup.finer]
    assert max(needed) > setup.body.body.config.max_substeps_per_frame


def viscous(body, strength):
    return body.body.effects([(effect_named("viscosity"), torch.tensor([strength]))], body.context())


@pytest.mark.usefixtures("taichi")
def test_an_effect_that_few_particles_can_take_finer_grids_can_take_too():
    (setup,) = small_simulation()[0].setups
    law = ClassicalLaw("neo_hookean", youngs_modulus=1e4, poissons_ratio=0.3)

    def possible(strength):
        try:
            return setup.body.min_substeps(law, viscous(setup.body, strength)) > 0
        except MasivError:
            return False

    strongest = max(filter(possible, np.geomspace(1.0, 1e6, 200)))
    assert (
        setup.body.min_substeps(law, viscous(setup.body, strongest))
        > 0.9 * setup.body.body.config.max_substeps_per_frame
    )
    for finer in setup.finer:
        assert finer.min_substeps(law, viscous(finer, strongest)) > 0


def viscous_model(strength):
    """A model of the small simulation whose ``strength`` of viscosity is a multiple of the greatest that it can take
    with the substeps of its law alone."""
    simulation, _ = small_simulation()
    (setup,) = simulation.setups
    model = Model(FAMILIES["neo_hookean"], "sticky").with_effect("viscosity")
    values = {p.name: p.start for p in simulation.parameters(model)}
    law = law_of(model.family, values)
    held = setup.body.held_substeps(law, simulation.held, (0, "neo_hookean"))

    def needed(eta):
        return setup.body.min_substeps(law, viscous(setup.body, eta))

    last = brentq(lambda eta: needed(eta) - HELD_MARGIN * held, 1.0, 6e3, xtol=0.1)
    return simulation, model, {**values, "viscosity.viscosity": strength * last}, (setup.body, law, held)


@pytest.mark.usefixtures("taichi")
def test_substeps_are_those_of_the_law_while_an_effect_is_weak():
    counts = []
    for strength in (0.01, 0.98, 1.02, 1.4, 1.5):
        _, _, values, (body, law, held) = viscous_model(strength)
        effects = viscous(body, values["viscosity.viscosity"])
        counts.append(body.substeps_with(held, law, effects) / held)
        assert body.substeps_with(held, law, effects) * HELD_MARGIN >= body.min_substeps(law, effects)
    assert counts == [1, 1, 2, 2, 4]


@pytest.mark.usefixtures("taichi")
def test_derivatives_are_taken_with_the_substeps_of_their_point():
    """Where substeps are doubled the motion jumps, its derivative does not."""
    simulation, model, values, _ = viscous_model(0.99)
    eta = values["viscosity.viscosity"]
    here, above = simulation.residual(model, values), {**values, "viscosity.viscosity": 1.01 / 0.99 * eta}
    fixed = simulation.held_at(values)
    np.testing.assert_array_equal(fixed.residual(model, values), here)
    with pytest.raises(NonFiniteError, match="needs substeps of"):
        fixed.residual(model, {**values, "viscosity.viscosity": 1.3 * eta})
    jump = np.abs(simulation.residual(model, above) - here).max()
    known = next(p for p in simulation.parameters(model) if p.name == "viscosity.viscosity")
    step = replace(known, step=0.01 / 0.99 * eta, upper=10 * eta)
    slope = derivative(residual_of(simulation, model), values, here, step)
    smooth = (here - simulation.residual(model, {**values, "viscosity.viscosity": 0.95 * eta})) / (0.05 * eta)
    np.testing.assert_allclose(slope, smooth, rtol=0, atol=0.1 * np.abs(smooth).max())
    assert jump / step.step > 3 * np.abs(smooth).max()
    onwards = (fixed.residual(model, above) - here) / (above["viscosity.viscosity"] - eta)
    np.testing.assert_allclose(onwards, smooth, rtol=0, atol=0.1 * np.abs(smooth).max())


@pytest.mark.usefixtures("taichi")
def test_a_fit_that_the_substep_stopped_goes_on_with_shorter_ones():
    simulation, _ = small_simulation()
    model = Model(FAMILIES["neo_hookean"], "sticky")
    values = {p.name: p.start for p in simulation.parameters(model)}

    def stiffer(factor):
        return {**values, "youngs_modulus": factor * values["youngs_modulus"]}

    simulation.residual(model, values)
    assert not simulation.shorten_substeps(model, stiffer(1.1))
    with pytest.raises(NonFiniteError, match="the law needs substeps of"):
        simulation.residual(model, stiffer(8.0))
    assert simulation.held_at(values).shorten_substeps(model, stiffer(8.0))
    simulation.residual(model, stiffer(8.0))
    assert not simulation.shorten_substeps(model, stiffer(8.0))
    assert not simulation.shorten_substeps(model, stiffer(1e6))  # there would be too many


@pytest.mark.usefixtures("taichi")
def test_an_effect_that_needs_too_many_substeps_is_named():
    simulation, model, values, _ = viscous_model(1.0)
    with pytest.raises(NonFiniteError, match="viscosity as strong as this"):
        simulation.residual(model, {**values, "viscosity.viscosity": 1e6})


@pytest.mark.usefixtures("taichi")
def test_a_model_has_a_share_of_what_finer_grids_change():
    simulation, _ = small_simulation()
    model = Model(FAMILIES["neo_hookean"], "sticky")
    values = {p.name: p.start for p in simulation.parameters(model)}
    (without,) = simulation.fields(model, values)
    change = np.random.default_rng(0).normal(size=(simulation.observations[0].time_count, *without.shape[1:]))
    corrected = replace(simulation.observations[0], grid_corrections=(0.9 * change, 1.1 * change))
    simulation = simulation.with_observations([corrected])
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
    other = simulation.with_observations([replace(observation, residual_std=2 * observation.residual_std)])
    rolled = simulation.rollouts
    np.testing.assert_allclose(other.residual(model, values), 0.5 * residual)
    assert other.rollouts == simulation.rollouts == rolled  # the rollout was known
    other.residual(model, {**values, "youngs_modulus": 1.1 * values["youngs_modulus"]})
    assert other.rollouts == simulation.rollouts == rolled + 1
    assert simulation.observations == (observation,)
    np.testing.assert_array_equal(simulation.residual(model, values), residual)


@pytest.mark.usefixtures("taichi")
def test_recordings_of_one_name_are_refused():
    """They would share their initial state."""
    (setup,) = small_simulation()[0].setups
    with pytest.raises(ValueError, match="different names"):
        FreeBodyModel([setup, setup])
