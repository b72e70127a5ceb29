"""Surfaces after paths: the pictures decide, and a killed run goes on where it was."""

import numpy as np
import pytest
import torch
from cube import OMEGA, VELOCITY, objective_of, scene, settings
from small import SMALL, only_first_quick

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identification.losses.images import pictures_of_each_frame
from masiv.identification.neural import surface_finetune
from masiv.identification.neural.training import TrainingResult
from masiv.identification.recording import FitRecording
from masiv.identification.stage import identify
from masiv.materials.load import load_law
from masiv.models.initial_state import InitialState
from masiv.pretraining.pretrain import pretrained_path


def trained(objective, error):
    """A result whose initial velocity is wrong by ``error`` [m/s]."""
    velocity = VELOCITY + np.array([error, 0.0, 0.0])
    law, state = load_law(pretrained_path("jelly")), InitialState.of_world(objective.problem.axes, velocity, OMEGA)
    return TrainingResult(law, (state,))


def finetune(objective, result):
    recording = FitRecording(objective, result.initial_states[0], objective.problem.frames)
    return surface_finetune.finetune_surfaces(
        [recording], result, "sticky", result.law, seed=0, checkpoint=Checkpoint(None), progress=lambda *_: None
    )


def image_loss(objective, report, name):
    """What results are compared by, from the errors that are reported."""
    config = objective.config
    color = config.finetune_color_weight * report.get(f"color_error_of_{name}", 0.0)
    return config.finetune_silhouette_weight * report[f"silhouette_error_of_{name}"] + color


def test_surfaces_correct_what_paths_had_wrong(filmed, seen):
    objective = objective_of(filmed, seen, velocity_learning_rate=0.06)
    better, loss, report = finetune(objective, trained(objective, 0.4))
    assert report["silhouette_error_of_surfaces"] < 0.8 * report["silhouette_error_of_paths"]
    assert abs(float(better.initial_states[0].velocity[0]) - VELOCITY[0]) < 0.2
    assert loss == pytest.approx(image_loss(objective, report, "surfaces"))
    assert objective.config.geometry_loss == "trajectory"  # the objective of the paths is not changed


@pytest.mark.slow
def test_a_finetune_that_is_farther_from_the_pictures_is_not_kept(filmed, seen):
    """Observed surfaces that drift backwards by 5 cm a frame draw the velocity away from the truth."""
    weights = {"finetune_silhouette_weight": 1e-3, "finetune_color_weight": 0.0}
    steps = {"velocity_learning_rate": 0.06, "law_learning_rate": 1e-9, "scale_learning_rate": 1e-9}
    objective = objective_of(filmed, seen, samples_per_frame=1, **weights, **steps)
    frames = torch.arange(1, objective.problem.frames + 1)
    objective.problem.targets = objective.problem.targets + 0.05 * frames[:, None, None] * torch.tensor([-1.0, 0, 0])
    right = trained(objective, 0.0)
    kept, loss, report = finetune(objective, right)
    assert kept is right
    assert loss == pytest.approx(image_loss(objective, report, "paths"))
    assert report["silhouette_error_of_surfaces"] > report["silhouette_error_of_paths"]


def test_the_weight_of_silhouettes_decides_between_paths_and_pictures(filmed, seen):
    """Paths that have drifted by 3 cm, and silhouettes that have not."""
    true, drift = torch.as_tensor(seen[1]), torch.tensor([0.03, 0.0, 0.0])
    for weight, prefers_true in ((0.01, False), (10.0, True)):
        objective = objective_of(filmed, seen, silhouette_weight=weight, samples_per_frame=1)
        problem = objective.problem
        here = problem.axes.points_to_simulation(true[1 : problem.frames + 1].double().numpy())
        here = torch.as_tensor(here, dtype=torch.float32)
        problem.targets = here + drift
        assert (objective.evaluate(here) < objective.evaluate(here + drift)) == prefers_true


def test_a_checkpoint_of_an_older_version_is_refused_in_a_sentence(filmed, seen):
    state = trained(objective_of(filmed, seen), 0.0).state()
    del state["objective"]
    with pytest.raises(MasivError, match="delete checkpoints/"):
        TrainingResult.from_state(state, load_law(pretrained_path("jelly")))


def test_there_is_a_surface_finetune_only_with_pictures_to_compare(filmed, seen):
    assert objective_of(filmed, seen).has_surface_finetune
    for changes in ({"surface_finetune": False}, {"geometry_loss": "surface"}, {"pictures": 0}):
        assert not objective_of(filmed, seen, **changes).has_surface_finetune
    assert not objective_of(scene(), seen).has_surface_finetune
    pictures = pictures_of_each_frame(filmed.views, 3, 2)
    assert [frame for frame, _ in pictures] == [1, 1, 2, 2, 3, 3]
    assert {view for _, view in pictures} == {0, 1, 2, 3}


@pytest.mark.slow
@pytest.mark.parametrize("stop", only_first_quick([("identify: fit surfaces", 1), ("identify: fit", 3)]))
def test_a_fit_that_is_killed_among_paths_or_surfaces_ends_with_the_same_numbers(filmed, seen, tmp_path, stop):
    class Stop(Exception):
        pass

    config = settings(iterations=4, pictures=1)
    whole = identify(filmed, seen[0], config, SMALL)
    assert whole.fit["silhouette_error_of_surfaces"] > 0
    assert [row["iteration"] for row in whole.fit["history"]] in ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3])

    def stops(stage, done, total, note=""):
        if (stage, done) == stop:
            raise Stop

    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(filmed, seen[0], config, SMALL, checkpoint=Checkpoint(path, every_s=0), progress=stops)
    resumed = identify(filmed, seen[0], config, SMALL, checkpoint=Checkpoint(path, every_s=0))
    assert whole.fit == resumed.fit
    for name, value in whole.law.state_dict().items():
        assert torch.equal(value, resumed.law.state_dict()[name])


def test_a_result_is_replaced_only_if_it_is_better_by_more_than_a_standard_error():
    """Paired by frame: differences that all frames share count, differences within their scatter do not."""
    before = torch.tensor([0.2, 0.4, 0.6, 0.8])
    scatter = torch.tensor([0.1, -0.1, 0.1, -0.1])
    clearly = surface_finetune.is_clearly_lower
    assert clearly(before - 0.01, before)
    assert clearly(before - 0.06 + scatter, before)  # the standard error is 0.058
    assert not clearly(before - 0.05 + scatter, before)
    assert not clearly(before, before)
    assert not clearly(before + 0.01, before)
    assert clearly(before[:1] - 0.01, before[:1])
