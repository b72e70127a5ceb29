"""Bodies in flight that share physics: exact flights, what is shared and what is not, and no free gravity a ball."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from dropped_balls import Ball, write_scene

from masiv.errors import InputError
from masiv.models.base import Model
from masiv.models.point_mass import RIGID, PointMassModel
from masiv.observations.tracks import flight_observations
from masiv.refinement.config import RefineConfig
from masiv.refinement.from_tracks import refine_group
from masiv.refinement.search_state import SearchSettings
from masiv.tracks.geometry import mean_diameter

pytestmark = pytest.mark.usefixtures("taichi")


def found(tracks):
    return refine_group(tracks, "balls", SearchSettings.of(RefineConfig.model_validate({})))


def test_flight_is_that_of_the_closed_form(tmp_path):
    balls = {"heavy": Ball(7.0, 0.2, 0.0), "light": Ball(0.03, 0.08, 0.5)}
    tracks = write_scene(tmp_path, balls, noise=0.0)
    simulation = PointMassModel(tracks, flight_observations(tracks, "balls"))
    assert len(simulation.observations) == 4
    for run in simulation.observations:
        ball = balls[run.body]
        model = Model(RIGID, "none", ("quadratic_drag",) if ball.drag else ())
        values = {"quadratic_drag.drag_coefficient": 0.5}
        members = simulation.members(model, values, run)
        drop = int(run.name[-1])
        path = simulation.ballistic_positions(run, members, np.array([[40.0 + drop, -0.3 * drop]]))[0]
        exact = 40 + drop - ball.fallen(run.times, 0.3 * drop)
        assert np.abs(path[:, 0] - exact).max() < (2e-5 if ball.drag else 1e-10)
        if not run.fitted:  # its start is found from its own flight
            np.testing.assert_allclose(simulation.start_of(run, model, values), [40 + drop, -0.3 * drop], atol=1e-4)


def test_one_coefficient_where_all_share_it(tmp_path):
    balls = {"heavy": Ball(7.0, 0.2, 0.47), "middle": Ball(0.06, 0.065, 0.47), "light": Ball(0.03, 0.08, 0.47)}
    refined = found(write_scene(tmp_path, balls))
    after = refined.search.after
    assert after.model.effects == ("quadratic_drag",)
    name = "quadratic_drag.drag_coefficient"
    assert after.values[name] == pytest.approx(0.47, abs=max(4 * after.stderr[name], 0.005))
    assert after.stderr[name] < 0.05
    assert after.validation_mm < 15


@pytest.mark.slow
def test_own_coefficients_and_a_body_that_lacks_nothing(tmp_path):
    balls = {"heavy": Ball(7.0, 0.2, 0.0), "middle": Ball(0.06, 0.065, 0.4), "light": Ball(0.03, 0.08, 0.7)}
    refined = found(write_scene(tmp_path, balls))
    after = refined.search.after
    assert sorted(after.model.effects) == ["quadratic_drag@light", "quadratic_drag@middle"]
    for body in ("middle", "light"):
        name = f"quadratic_drag@{body}.drag_coefficient"
        assert after.values[name] == pytest.approx(balls[body].drag, rel=0.03)
    # One gravity of its own a ball would fit as well as drag, nearly; one of all does not.
    gravity = next(t for t in refined.search.rounds[0].trials if t.candidate.effect == "gravity_scale")
    best = max(t.log_bayes_factor for t in refined.search.rounds[0].trials if t.log_bayes_factor is not None)
    assert gravity.log_bayes_factor < best - 10
    assert refined.search.rounds[0].candidates
    assert not any(c.effect.startswith("gravity_scale@") for c in refined.search.rounds[0].candidates)
    linear = next(t for t in refined.search.rounds[0].trials if t.candidate.effect == "linear_drag")
    assert any("it takes a medium of" in reason for reason in linear.impossible)
    [common] = refined.shared
    assert set(common.term.bodies) == {"middle", "light"}
    assert common.log_bayes_factor < 0  # the data asks for one each


def test_clean_flights_lack_nothing(tmp_path):
    balls = {"heavy": Ball(7.0, 0.2, 0.0), "light": Ball(0.03, 0.08, 0.0)}
    refined = found(write_scene(tmp_path, balls))
    assert refined.search.after.model.effects == ()
    assert refined.forward_model.observations[0].noise_std == pytest.approx(0.01, rel=0.4)


def test_what_cannot_be_a_group(tmp_path):
    tracks = write_scene(tmp_path, {"one": Ball(1, 0.1, 0)}, runs=(1,))
    with pytest.raises(InputError, match="hold_out"):
        found(tracks)
    with pytest.raises(InputError, match="no group 'ball': it has balls"):
        flight_observations(tracks, "ball")
    assert mean_diameter(tracks.bodies["one"].geometry) == pytest.approx(0.1)


def measured_folder() -> Path:
    folder = Path(os.environ.get("MASIV_MEASURED", Path(__file__).parents[2] / "shared" / "measured")) / "ball_drops"
    if not folder.is_dir():
        pytest.skip("no measured data: set MASIV_MEASURED to the folder that holds ball_drops")
    return folder


def test_measured_balls():
    """Drag for the light balls, each its own; nothing for the heavy ones. See benchmarks/measured.md."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    from measured import ball_scene

    refined = found(ball_scene(measured_folder()))
    after = refined.search.after
    assert sorted(after.model.effects) == [
        "quadratic_drag@Tennis Ball", "quadratic_drag@Whiffle Ball 1", "quadratic_drag@Yellow Whiffle Ball"
    ]  # fmt: skip
    errors = refined.forward_model.by_body(after.model, after.values, "hold_out")
    assert errors["Tennis Ball"] < 350
    assert errors["Whiffle Ball 1"] < 300
    assert errors["Bowling Ball"] == pytest.approx(91, abs=2)
    assert {name for name, body in refined.bodies.items() if body.objections} == {
        "Baseball",
        "Bowling Ball",
        "Golf Ball",
    }
