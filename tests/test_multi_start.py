"""Two starts that few particles cannot distinguish: both are fitted, the better fit is kept."""

import pytest
from cube import scene, settings
from small import SMALL

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identification.losses.objective import Objective
from masiv.identification.neural import multi_start
from masiv.identification.neural.starting_law import StartingLaw
from masiv.identification.neural.training import TrainingResult
from masiv.identification.recording import FitRecording
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState
from masiv.pretraining.pretrain import pretrained_path
from masiv.progress import silent


def fit(seen, monkeypatch, errors, objectives, image_losses=None):
    """The material that is kept, and those that were fitted. errors: of starting laws; objectives: of fits, None
    diverges; image_losses: after the surface finetune of each, None without such a finetune."""
    fitted, laws = [], {name: NeuralLaw(seed=k) for k, name in enumerate(errors)}
    changes = {"surface_finetune": image_losses is not None, "pictures": 1}
    config = settings(**changes)
    problem = FilmedBody(scene(), seen[0], SMALL, samples=config.samples_per_frame)
    objective = Objective(problem, config)
    monkeypatch.setattr(Objective, "has_surface_finetune", image_losses is not None)

    def train(recordings, law, *_, **__):
        name = next(name for name, known in laws.items() if known is law)
        fitted.append(name)
        if objectives[name] is None:
            raise MasivError("identify: the fit keeps diverging")
        return TrainingResult(law, (recordings[0].initial_state,), 0.01, objectives[name])

    starts = [StartingLaw(name, "sticky", laws[name], error) for name, error in errors.items()]
    monkeypatch.setattr(multi_start, "choose_starting_laws", lambda *_: starts)
    monkeypatch.setattr(multi_start, "train", train)
    if image_losses is not None:
        by_objective = {objectives[name]: image_losses[name] for name in image_losses}
        monkeypatch.setattr(
            multi_start,
            "finetune_surfaces",
            lambda _, trained, *__, **___: (trained, by_objective[trained.objective], {}),
        )
    initial_state = InitialState.of_world(problem.axes, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    recordings = [FitRecording(objective, initial_state, 3)]
    result = multi_start.fit_neural_law(recordings, lambda: objective, 0, Checkpoint(None), silent)
    return result.report["start"], fitted


@pytest.mark.parametrize(
    ("errors", "objectives", "kept", "both"),
    [
        ({"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": 0.3, "plasticine": 0.2}, "plasticine", True),
        ({"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": 0.2, "plasticine": 0.3}, "maxwell_fluid", True),
        ({"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": 0.2, "plasticine": None}, "maxwell_fluid", True),
        ({"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": None, "plasticine": 0.3}, "plasticine", True),
        ({"maxwell_fluid": 0.1, "plasticine": 0.14}, {"maxwell_fluid": 0.3, "plasticine": 0.2}, "maxwell_fluid", False),
        # A yield that was not reached would be invented.
        ({"jelly": 0.1, "plasticine": 0.1}, {"jelly": 0.2, "plasticine": 0.19}, "jelly", True),
    ],
)
def test_the_better_of_two_fits_is_kept(seen, monkeypatch, errors, objectives, kept, both):
    result, fitted = fit(seen, monkeypatch, errors, objectives)
    assert result == kept
    assert fitted == list(errors)[: 2 if both else 1]


def test_fits_are_compared_after_the_surface_finetune(seen, monkeypatch):
    starts, fits = {"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": 0.3, "plasticine": 0.2}
    kept, fitted = fit(seen, monkeypatch, starts, fits, {"maxwell_fluid": 0.18, "plasticine": 0.19})
    assert kept == "maxwell_fluid"
    assert fitted == ["maxwell_fluid", "plasticine"]


def test_if_every_fit_diverges_the_stage_says_so(seen, monkeypatch):
    with pytest.raises(MasivError, match="keeps diverging"):
        fit(seen, monkeypatch, {"maxwell_fluid": 0.1, "plasticine": 0.12}, {"maxwell_fluid": None, "plasticine": None})


@pytest.mark.slow
def test_the_second_of_two_fits_goes_on_where_it_was_killed(seen, tmp_path):
    class Stop(Exception):
        pass

    config = settings(iterations=4)
    problem = FilmedBody(scene(), seen[0], SMALL, samples=config.samples_per_frame)
    recordings = [
        FitRecording(Objective(problem, config), InitialState.of_world(problem.axes, [0.0] * 3, [0.0] * 3), 3)
    ]
    starts = [
        StartingLaw(name, "sticky", load_law(pretrained_path(name)), 0.1).state() for name in ("jelly", "plasticine")
    ]

    def fitted(name, progress):
        checkpoint = Checkpoint(tmp_path / f"{name}.pt", every_s=0)
        if checkpoint.load() is None:
            checkpoint.save({"starts": starts})
        result = multi_start.fit_neural_law(recordings, lambda: pytest.fail("no search"), 0, checkpoint, progress)
        checkpoint.clear()
        return result

    def stops(stage, done, *_):
        if (stage, done) == ("identify: fit, second start", 2):
            raise Stop

    whole, steps = fitted("whole", silent), []
    with pytest.raises(Stop):
        fitted("killed", stops)
    resumed = fitted("killed", lambda stage, done, *_: steps.append((stage, done)))
    assert [done for stage, done in steps if stage == "identify: fit, second start"] == [2, 3, 4]
    assert resumed.report == whole.report
    assert resumed.trajectory_error == whole.trajectory_error
    assert resumed.history == whole.history
    assert not list(tmp_path.glob("*.pt"))
