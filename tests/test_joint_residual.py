"""A classical law is fitted to paths and pictures: paths drift, pictures do not."""

from dataclasses import replace

import numpy as np
import pytest
from cube import OMEGA, VELOCITY, Seen, objective_of

from masiv.checkpoint import Checkpoint
from masiv.identification.classical.fit import fit_all_particles, fit_family, fit_further
from masiv.identification.classical.residuals import JointResidual
from masiv.identification.classical.search import search_family
from masiv.materials.classical import ClassicalLaw
from masiv.models.families import FAMILIES
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.progress import silent

TRUE = {"youngs_modulus": 3e4, "poissons_ratio": 0.3}
DRIFT = np.array([0.25, 0.0, 0.0])
"""[m/s]"""


def values_of(objective, **changes):
    state = InitialState.of_world(objective.problem.axes, VELOCITY, OMEGA)
    start = initial_state_parameters(state, objective.ground_range)
    return {**TRUE, **{p.name: p.start for p in start}, **changes}


def test_paths_come_first_and_are_metres_again(filmed, seen):
    objective = objective_of(filmed, seen, samples_per_frame=2)
    problem = objective.problem
    plain, both = (JointResidual(objective, FAMILIES["neo_hookean"], "sticky", 3, with_images=w) for w in (False, True))
    paths, squared = both(values_of(objective))
    assert paths.shape == (6, problem.count, 3)
    np.testing.assert_allclose(both.path_part(squared), paths.ravel(), rtol=1e-6)
    alone, flat = plain(values_of(objective))
    np.testing.assert_array_equal(alone, paths)
    np.testing.assert_array_equal(flat, paths.ravel())
    rows = np.random.default_rng(0).normal(size=(len(squared), 2))
    assert both.path_part(rows).shape == (paths.size, 2)
    mean_square = float((paths**2).sum(2).mean()) / problem.size**2
    assert (squared[: paths.size] ** 2).sum() == pytest.approx(mean_square, rel=1e-4)


def test_pictures_are_nearest_at_the_truth(filmed, seen):
    objective = objective_of(filmed, seen)
    problem = objective.problem
    joint = JointResidual(objective, FAMILIES["neo_hookean"], "sticky", problem.frames, with_images=True)

    def of_pictures(**changes):
        _, squared = joint(values_of(objective, **changes))
        return float((squared[joint.path_rows :] ** 2).sum())

    here = of_pictures()
    for changes in ({"velocity_x": 0.7}, {"velocity_x": 0.3}, {"youngs_modulus": 1.2e4}, {"ground_offset": 0.02}):
        assert of_pictures(**changes) > 1.02 * here


@pytest.mark.slow
def test_paths_that_drift_are_overruled(filmed, seen):
    true = seen[0]
    drift = (DRIFT * true.times[:, None, None]).astype(np.float32)
    drifted = Seen(true.positions + drift, true.times, true.volume), seen[1]
    off = []
    objective = objective_of(filmed, drifted, family_rollouts=25, samples_per_frame=1)
    start = InitialState.of_world(objective.problem.axes, VELOCITY + DRIFT, OMEGA)
    for with_images in (False, True):
        fit = fit_family(
            "neo_hookean", objective, start, objective.problem.frames, Checkpoint(None), silent,
            budget_factor=0.5, with_images=with_images,
        )  # fmt: skip
        fit = fit_further(fit, objective, silent, with_images=with_images)
        fit = fit_all_particles(fit, objective, objective, Checkpoint(None), silent, with_images=with_images)
        off.append(abs(fit.values["velocity_x"] - VELOCITY[0]))
    assert off[0] > 0.8 * DRIFT[0]
    assert off[1] < 0.3 * DRIFT[0]


def test_the_coarse_search_compares_pictures_too(filmed, seen, monkeypatch):
    """Paths as a body twenty times as stiff would have them."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=6e5, poissons_ratio=0.3)
    objective = objective_of(filmed, seen, silhouette_weight=5.0, color_weight=0.0)
    problem = objective.problem
    problem.targets = problem.run(law, InitialState.of_world(problem.axes, VELOCITY, OMEGA), "sticky", problem.frames)
    family = replace(FAMILIES["neo_hookean"], search={"youngs_modulus": (3e4, 6e5)})
    start = InitialState.of_world(problem.axes, VELOCITY, OMEGA)
    found = [
        search_family(objective, family, start, silent, with_images=w).values["youngs_modulus"] for w in (False, True)
    ]
    assert found == [6e5, 3e4]
