"""The smooth force for what no effect explains: is it where, when and along what pushed?"""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from flight import COUNT, FITTED, FPS, observed, scene
from linear_model import FITTED as FITTED_INSTANTS
from linear_model import POINTS, TIMES, baseline
from pushed_points import PushedPoints
from scipy.stats import multivariate_normal
from small import SMALL, only_first_quick

from masiv.errors import NonFiniteError
from masiv.identification.config import IdentifyConfig
from masiv.inference.gaussian_prior import most_probable
from masiv.observations.motion import SampledMotion
from masiv.refinement.config import RefineConfig
from masiv.refinement.discrepancy import DISCREPANCY_FORCE, discrepancy_force
from masiv.refinement.document import document
from masiv.refinement.document_text import text
from masiv.refinement.from_video import Recording, refine_recordings
from masiv.refinement.residual_arrays import arrays
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.stage import refine
from masiv.scene.transforms import SimulationFrame

GUST, PUSH = (0.3, 0.5), np.array([8.0, 0.0, 6.0])
"""Begin and end [s], acceleration [m/s^2]."""
INTERVAL = TIMES[1]
TILTED = SimulationFrame.from_scene(np.array([0.6, 0.0, 0.8]), None)
SETTINGS = SearchSettings.of(RefineConfig.model_validate({}))


def gust(times, places):
    on = (times >= GUST[0]) & (times < GUST[1])
    return on[:, None, None] * PUSH * np.ones_like(places)


def attraction(times, places):
    """Towards a line through the middle, along z, weaker and weaker."""
    pull = -1.0 * (places - POINTS.mean(0)) * np.array([1.0, 1.0, 0.0])
    return (1 - 0.5 * times)[:, None, None] * pull


def cosine(a, b):
    return float((a * b).sum() / np.linalg.norm(a) / np.linalg.norm(b))


@pytest.mark.parametrize("axes", only_first_quick([TILTED, None]))
def test_a_gust_is_found_where_when_and_along_what_it_blew(axes):
    model = PushedPoints(gust, axes)
    start = model.rollouts
    result = refine(model, [baseline(model)], SETTINGS)
    assert (result.verdict, result.accepted) == ("unexplained residual", ())
    assert result.twin_fit.model.effects == (DISCREPANCY_FORCE,)
    assert model.rollouts - start < 150  # 66 coefficients, once; the rest is the search
    written = document(result)
    force = written["discrepancy_force"]
    assert force["in_twin"]
    assert force["share"]["fit"] > 0.99
    assert force["share"]["validation"] > 0.9
    peak = force["peak"]
    assert GUST[0] - INTERVAL < peak["time"]["value"] < GUST[1] + INTERVAL
    assert cosine(peak["direction"], PUSH) > 0.95
    assert np.linalg.norm(peak["direction"]) == pytest.approx(1.0)
    assert peak["acceleration"]["value"] == pytest.approx(10.0, rel=0.3)
    instant = int(np.abs(TIMES - peak["time"]["value"]).argmin())
    seen = model.observations[0].values[instant]
    assert np.linalg.norm(seen - peak["place"]["value"], axis=1).min() < 1e-9
    assert f"strongest at {peak['time']['value']:.2f} s" in text(written)
    held = arrays(result)
    places, field = held["force_places@a"], held["force@a"]
    assert places.shape == field.shape == (len(TIMES), len(POINTS), 3)
    during = field[(TIMES > GUST[0] + INTERVAL) & (TIMES < GUST[1] - INTERVAL)]
    assert cosine(during, np.broadcast_to(PUSH, during.shape)) > 0.95
    assert np.abs(field[:8]).max() < 2.0


def test_a_pull_to_a_line_is_found_as_a_field_in_space():
    model = PushedPoints(attraction)
    result = refine(model, [baseline(model)], SETTINGS)
    held = arrays(result)
    field, at = held["force@a"][:FITTED_INSTANTS], held["force_places@a"][:FITTED_INSTANTS]
    near = ((at[0][:, None] - POINTS[None]) ** 2).sum(2).argmin(1)
    true = attraction(TIMES[:FITTED_INSTANTS], np.broadcast_to(POINTS[near], field.shape))
    assert cosine(field, true) > 0.8
    assert document(result)["discrepancy_force"]["share"]["fit"] > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_there_is_no_force_where_nothing_is_missing(seed):
    model = PushedPoints(lambda times, places: np.zeros_like(places), seed=seed)
    fit = baseline(model)
    std = [e.observation_std for e in model.observations]
    assert discrepancy_force(SearchState(model, fit, std, 5e-3), SETTINGS) is None


class Fragile(PushedPoints):
    """With a force it cannot be simulated."""

    def fields(self, model, values, *, held_out=False):
        if DISCREPANCY_FORCE in model.effects:
            raise NonFiniteError(3, 4, "it flew apart")
        return super().fields(model, values, held_out=held_out)


@pytest.mark.slow
def test_what_cannot_be_simulated_has_no_force():
    model = Fragile(gust)
    result = refine(model, [baseline(model)], SETTINGS)
    assert result.verdict == "unexplained residual"
    assert document(result)["discrepancy_force"] is None
    assert "force@a" not in arrays(result)


def test_most_probable_coefficients_and_their_evidence_are_those_of_a_normal_distribution():
    random = np.random.default_rng(0)
    columns, residual = random.normal(size=(12, 5)), random.normal(size=12)
    root = random.normal(size=(5, 5))
    prior, std = root @ root.T + np.eye(5), 0.7
    chosen = most_probable(residual, columns, 12, [np.linalg.inv(prior)], [std])
    covariance = columns @ prior @ columns.T + std**2 * np.eye(12)
    np.testing.assert_allclose(chosen.x, -prior @ columns.T @ np.linalg.solve(covariance, residual))
    kept = prior - prior @ columns.T @ np.linalg.solve(covariance, columns @ prior)
    np.testing.assert_allclose(chosen.covariance, kept, atol=1e-12)
    expected = multivariate_normal.logpdf(residual, np.zeros(12), covariance) + 6 * np.log(2 * np.pi)
    assert chosen.log_evidence == pytest.approx(expected)


def test_of_priors_and_errors_the_data_chooses():
    random = np.random.default_rng(1)
    columns = random.normal(size=(200, 20))
    residual = -columns @ random.normal(0, 3.0, 20) + random.normal(0, 0.5, 200)
    sizes, stds = (0.1, 3.0, 90.0), (0.05, 0.5, 5.0)
    chosen = most_probable(residual, columns, 200, [np.eye(20) / s**2 for s in sizes], stds)
    assert chosen.std == 0.5
    np.testing.assert_allclose(chosen.precision, np.eye(20) / 9)


@pytest.mark.slow
@pytest.mark.usefixtures("taichi")
def test_a_gust_on_a_simulated_body():
    """A push in mid-flight, which no effect of the library is."""
    unknown = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "unknown_effects.py"))["UNKNOWN"]
    begin, end, size = 0.1, 0.2, 20.0
    motion = observed({unknown["gust"]: [size, begin, end]})
    known = SampledMotion(motion.positions[:FITTED], motion.times[:FITTED], motion.volume)
    config = RefineConfig.model_validate(
        {"particles": COUNT, "laws": ["neo_hookean"], "shortlist": 1, "samples_per_frame": 1, "max_effects": 1,
         "effects": ["linear_drag"]}
    )  # fmt: skip
    recordings = [Recording("run", scene(), known, motion, FITTED)]
    result = refine_recordings(recordings, IdentifyConfig.model_validate({"contact": "sticky"}), SMALL, config)
    force = document(result)["discrepancy_force"]
    assert result.verdict == "unexplained residual"
    assert cosine(force["peak"]["direction"], np.array([1.0, 0.0, 0.3])) > 0.8
    assert begin - 2 / FPS <= force["peak"]["time"]["value"] <= end + 2 / FPS
    assert force["share"]["fit"] > 0.5
