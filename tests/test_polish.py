"""Surfaces after paths: silhouettes decide, and a killed run goes on where it was."""

import dataclasses

import numpy as np
import pytest
import torch
from ring_scene import look_at
from test_identify import GRAVITY, OMEGA, VELOCITY, body, scene, seen, settings  # noqa: F401  (fixtures)

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify import polish
from masiv.identify.fit import Fit, fit_from, fit_state
from masiv.identify.objective import objective
from masiv.identify.pictures import some_of_each
from masiv.identify.problem import Problem
from masiv.identify.stage import identify
from masiv.identify.throw import Throw
from masiv.materials.load import load_law
from masiv.models.initial_state import InitialState
from masiv.mpm.config import SimulatorConfig
from masiv.pretraining.pretrain import pretrained_path
from masiv.scene.scene import Frame
from masiv.splat.rasteriser import render

SIDE = 48


@pytest.fixture(scope="module")
def filmed(seen):  # noqa: F811
    """The scene of test_identify, seen by four cameras as silhouettes of the true motion."""
    positions = seen[1]
    target = positions[4].mean(0).astype(float)
    angles = np.deg2rad([10, 100, 190, 280])
    cameras = tuple(
        look_at(f"{k}", target + 2.0 * np.array([np.cos(a), 0.4, np.sin(a)]), target, SIDE, 55.0)
        for k, a in enumerate(angles)
    )

    def load(view, frame):
        count = positions.shape[1]
        picture = render(cameras[view], torch.as_tensor(positions[frame]), torch.full((count,), 0.03),
                         torch.full((count,), 0.9), torch.zeros(count, 3), torch.zeros(3))  # fmt: skip
        mask = (picture.alpha.detach() > 0.5).float().numpy()
        return Frame(np.zeros((SIDE, SIDE, 3), np.uint8), mask, np.ones((SIDE, SIDE), bool))

    return dataclasses.replace(scene(), cameras=cameras, load=load, mask_source="alpha")


def problem_of(filmed, seen, **changes):  # noqa: F811
    config = settings(**{"pictures": 4, "iterations": 16, **changes})
    return Problem(filmed, seen[0], config, SimulatorConfig())


def rigid_initial_state(problem, error):
    velocity = VELOCITY + np.array([error, 0.0, 0.0])
    return Fit(load_law(pretrained_path("jelly")), (InitialState.of_world(problem.axes, velocity, OMEGA),))


def polished(problem, fitted):
    throw = Throw(problem, fitted.motions[0], problem.frames)
    return polish.polish(
        [throw], fitted, "sticky", fitted.law, seed=0, checkpoint=Checkpoint(None), progress=lambda *_: None
    )


def picture_sum(problem, report, name):
    """What fits are compared by, from the errors that are reported."""
    paint = problem.config.polish_paint_weight * report.get(f"paint_error_of_{name}", 0.0)
    return problem.config.polish_silhouette_weight * report[f"silhouette_error_of_{name}"] + paint


def test_surfaces_correct_what_paths_had_wrong_and_silhouettes_refuse_what_they_make_worse(filmed, seen, monkeypatch):  # noqa: F811
    problem = problem_of(filmed, seen, velocity_learning_rate=0.06)
    wrong = rigid_initial_state(problem, 0.4)
    better, nearness, first = polished(problem, wrong)
    assert first["silhouette_error_of_surfaces"] < 0.8 * first["silhouette_error_of_paths"]
    assert abs(float(better.motions[0].velocity[0]) - VELOCITY[0]) < 0.2
    assert problem.config.geometry_loss == "trajectory"  # the problem of the paths is as it was
    monkeypatch.setattr(polish, "fit", lambda *_, **__: rigid_initial_state(problem, 0.4))
    right = rigid_initial_state(problem, 0.0)
    kept, nearer, report = polished(problem, right)
    assert kept is right
    assert nearer == pytest.approx(picture_sum(problem, report, "paths"))
    assert nearness == pytest.approx(picture_sum(problem, first, "surfaces"))
    assert report["silhouette_error_of_surfaces"] > report["silhouette_error_of_paths"]


def test_a_fit_keeps_what_its_whole_objective_likes_best(filmed, seen):  # noqa: F811
    """Paths that have drifted by 3 cm, and silhouettes that have not: the weight between them decides."""
    true, drift = torch.as_tensor(seen[1]), torch.tensor([0.03, 0.0, 0.0])
    for weight, prefers_true in ((0.01, False), (10.0, True)):
        problem = problem_of(filmed, seen, silhouette_weight=weight, samples_per_frame=1)
        here = problem.axes.points_to_simulation(true[1 : problem.frames + 1].double().numpy())
        here = torch.as_tensor(here, dtype=torch.float32)
        problem.targets = here + drift
        assert (objective(problem, here) < objective(problem, here + drift)) == prefers_true


def test_a_checkpoint_of_an_older_fit_is_refused_in_a_sentence(filmed, seen):  # noqa: F811
    state = fit_state(rigid_initial_state(problem_of(filmed, seen), 0.0))
    del state["objective"]
    with pytest.raises(MasivError, match="delete what is in checkpoints/"):
        fit_from(state, load_law(pretrained_path("jelly")))


def test_surfaces_have_the_last_word_only_where_silhouettes_can_judge(filmed, seen):  # noqa: F811
    assert polish.wanted(problem_of(filmed, seen))
    for changes in ({"polish": False}, {"geometry_loss": "surface"}, {"pictures": 0}):
        assert not polish.wanted(problem_of(filmed, seen, **changes))
    assert not polish.wanted(problem_of(scene(), seen))
    pictures = some_of_each(problem_of(filmed, seen), 3, 2)
    assert [frame for frame, _ in pictures] == [1, 1, 2, 2, 3, 3]
    assert {view for _, view in pictures} == {0, 1, 2, 3}


@pytest.mark.parametrize("stop", [("identify: fit", 3), ("identify: fit surfaces", 1)])
def test_a_fit_that_is_killed_among_paths_or_surfaces_ends_with_the_same_numbers(filmed, seen, tmp_path, stop):  # noqa: F811
    class Stop(Exception):
        pass

    config = settings(iterations=4, pictures=1)
    whole = identify(filmed, seen[0], config, SimulatorConfig())
    assert whole.fit["silhouette_error_of_surfaces"] > 0
    assert [row["iteration"] for row in whole.fit["history"]] in ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3])

    def stops(stage, done, total, note=""):
        if (stage, done) == stop:
            raise Stop

    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(filmed, seen[0], config, SimulatorConfig(), checkpoint=Checkpoint(path, every_s=0), progress=stops)
    resumed = identify(filmed, seen[0], config, SimulatorConfig(), checkpoint=Checkpoint(path, every_s=0))
    assert whole.fit == resumed.fit
    for name, value in whole.law.state_dict().items():
        assert torch.equal(value, resumed.law.state_dict()[name])
