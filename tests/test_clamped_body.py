"""The model of a clamped body with markers: which rollouts it keeps, and which effects it offers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from masiv.effects.catalogue import effects
from masiv.errors import NonFiniteError
from masiv.identification.tracks import clamped_body_model
from masiv.inference.model_fit import gauss_newton_fit
from masiv.models.base import Model
from masiv.models.families import family_of
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground
from masiv.tracks.config import TracksConfig
from masiv.tracks.read import read_tracks

pytestmark = pytest.mark.usefixtures("taichi")
SIMULATOR = SimulatorConfig(courant_number=0.6, max_substeps_per_frame=4000)
TRACKS = TracksConfig(particles=64, duration=0.05)
KNOWN = {"youngs_modulus": 2e5, "poissons_ratio": 0.2}
MODEL = Model(family_of("neo_hookean", 1070, KNOWN), "none")


@pytest.fixture(scope="module")
def bar():
    tracks = read_tracks(Path(__file__).parent / "golden" / "bar")
    return replace(tracks, runs=tuple(run for run in tracks.runs if run.name == "own_a"))


def heavier(tracks):
    (name,) = tracks.bodies
    return replace(tracks, bodies={name: replace(tracks.bodies[name], density=2140.0)})


def with_lower_clamp(tracks):
    (name,) = tracks.bodies
    (clamp,) = tracks.bodies[name].clamps
    lower = replace(clamp, heights=clamp.heights + 0.02)
    return replace(tracks, bodies={name: replace(tracks.bodies[name], clamps=(lower,))})


CHANGES = {
    "density": (heavier, {}),
    "clamp": (with_lower_clamp, {}),
    "gravity": (lambda t: replace(t, gravity=0.5 * t.gravity), {}),
    "law": (lambda t: t, {"youngs_modulus": 1e5}),
}


def model_of(tracks, folder, simulator=SIMULATOR, **known):
    return clamped_body_model(tracks, "", TRACKS, simulator, known={**KNOWN, **known}, folder=folder)


@pytest.mark.parametrize("what", CHANGES)
def test_a_rollout_of_another_body_is_not_taken_from_disk(bar, tmp_path, what):
    change, known = CHANGES[what]
    first = model_of(bar, tmp_path)
    (before,) = first.fields(MODEL, {})
    again = model_of(bar, tmp_path)
    np.testing.assert_array_equal(again.fields(MODEL, {})[0], before)
    assert (first.rollouts, again.rollouts) == (1, 0)
    other = model_of(change(bar), tmp_path, **known)
    (after,) = other.fields(MODEL, {})
    assert other.rollouts == 1
    assert np.abs(after - before).max() > 1e-5
    np.testing.assert_array_equal(after, model_of(change(bar), None, **known).fields(MODEL, {})[0])


def test_a_rollout_with_another_substep_is_not_taken_from_disk(bar, tmp_path):
    """What a law's rollout is depends on the law that was simulated before it, whose substep is held."""
    family = family_of("neo_hookean", 1070, {"poissons_ratio": 0.2})
    model = Model(family, "none")

    def fields(folder, *moduli):
        forward = clamped_body_model(bar, "", TRACKS, SIMULATOR, known={"poissons_ratio": 0.2}, folder=folder)
        return [forward.fields(model, {"youngs_modulus": modulus})[0] for modulus in moduli][-1]

    alone, after_a_stiffer_one = fields(None, 1e5), fields(None, 3e5, 1e5)
    assert np.abs(alone - after_a_stiffer_one).max() > 0
    np.testing.assert_array_equal(fields(tmp_path, 3e5, 1e5), after_a_stiffer_one)
    np.testing.assert_array_equal(fields(tmp_path, 1e5), alone)


def test_a_law_that_is_stiffer_than_the_held_substep_allows_is_refused(bar):
    model = Model(family_of("neo_hookean", 1070, {"poissons_ratio": 0.2}), "none")
    forward = clamped_body_model(bar, "", TRACKS, SIMULATOR, known={"poissons_ratio": 0.2})
    forward.fields(model, {"youngs_modulus": 1e5})
    with pytest.raises(NonFiniteError, match="the law needs substeps of"):
        forward.fields(model, {"youngs_modulus": 1e6})
    forward.held.clear()
    forward.fields(model, {"youngs_modulus": 1e6})


def test_effects_that_are_not_simulated_are_not_offered(bar):
    on_table = replace(bar, ground=Ground(bar.up, -1.0))
    offered = model_of(on_table, None).candidates(replace(MODEL, contact="sticky"))
    assert {"linear_drag", "restitution", "point_mass"} <= set(offered)
    assert not {"time_offset", "ground_height"} & set(offered)
    assert "restitution" not in model_of(bar, None).candidates(MODEL)


@pytest.mark.parametrize("name", [name for name, effect in effects().items() if effect.hints.inside])
def test_guesses_of_places_in_the_body_are_possible_values(bar, name):
    """A load that hangs from the very face, half a spacing outside of the outermost particles, too."""
    term = model_of(bar, None).term(name)
    lower, upper = np.array([(p.lower, p.upper) for p in term.others]).T
    guesses = np.array(term.guesses)
    assert len(guesses)
    assert (guesses >= lower - 1e-9).all()
    assert (guesses <= upper + 1e-9).all()


def test_shapes_that_do_not_fit_are_refused(bar):
    forward = model_of(bar, None)
    (run,) = forward.observations
    body = forward.body(run)
    with pytest.raises(ValueError, match=r"a prediction has shape \(3, 2, 3\)"):
        run.residual(np.zeros((3, 2, 3)))
    with pytest.raises(ValueError, match=r"residual_std has shape \(3,\), it must be"):
        replace(run, residual_std=np.ones(3))
    with pytest.raises(ValueError, match=r"a body's gravity has shape \(2,\)"):
        replace(body, gravity=np.zeros(2))
    state = replace(body.released(), velocity=body.released().velocity[1:])
    with pytest.raises(ValueError, match="the state's velocity has shape"):
        body.rollout(forward.law(MODEL, {}), state, [1], substep=1e-4, contact="none")


def test_what_was_not_measured_leaves_no_residual(bar):
    (run,) = model_of(bar, None).observations
    values = run.values.copy()
    values[2, 1, 0] = np.nan
    field = replace(run, values=values).residual(run.values + 1.0)
    expected = np.ones_like(field)
    expected[2, 1, 0] = 0.0
    np.testing.assert_allclose(field, expected, rtol=0, atol=1e-12)


def test_effects_divide_the_substep_of_the_law_if_they_are_strong(bar):
    forward_model = model_of(bar, None)
    (run,) = forward_model.observations
    times = np.linspace(0, 0.05, 21)
    viscous = MODEL.with_effect("viscosity")

    def substep(strength, at=None):
        model = forward_model if at is None else forward_model.held_at({"viscosity.viscosity": at})
        return model.substep(run, viscous, {"viscosity.viscosity": strength}, times)

    held = forward_model.substep(run, MODEL, {}, times)
    body, law = forward_model.body(run), forward_model.law(MODEL, {})
    weakest = next(s for s in np.geomspace(0.1, 500, 100) if substep(s) < held)
    assert substep(0.1) == held
    assert held / substep(weakest) == 2.0
    assert substep(0.99 * weakest, at=weakest) == substep(weakest) == substep(weakest, at=weakest)
    acting = forward_model.acting(run, viscous, {"viscosity.viscosity": 500.0}, 0.05)
    assert substep(500.0) <= body.substep(law, times, acting) < held
    with pytest.raises(NonFiniteError, match="the law with its effects needs substeps"):
        substep(500.0, at=0.1)


def test_the_shape_in_which_a_body_was_held_is_found(bar):
    """Markers are at rest where a hand holds them, 4 mm below the straight bar: their motion begins there."""
    (run,) = (replace(r, held_straight=False) for r in bar.runs)
    forward = model_of(replace(bar, runs=(run,)), None)
    (seen,) = forward.observations
    name = f"tip_deflection@{seen.name}"
    assert name in {p.name for p in forward.parameters(MODEL)}
    straight, held = (forward.path(seen, MODEL, {name: value})(seen.times) for value in (0.0, -0.004))
    np.testing.assert_allclose(held[0], straight[0], rtol=0, atol=1e-3)
    assert np.abs(held - straight).max() > 5e-4
    moved = forward.over([replace(seen, values=held)])
    fitted = gauss_newton_fit(moved, MODEL, {}, budget=40)
    assert fitted.values[name] == pytest.approx(-0.004, abs=2e-4)
    assert fitted.fit_mm < 0.02
