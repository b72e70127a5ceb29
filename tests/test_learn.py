"""Two starts that few particles cannot tell apart: both are fitted, the better fit is kept."""

import pytest
from test_identify import body, scene, seen, settings  # noqa: F401  (fixtures)

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify import learn
from masiv.identify.fit import Fit
from masiv.identify.problem import Problem
from masiv.identify.start import Start
from masiv.identify.throw import Throw
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState
from masiv.mpm.config import SimulatorConfig
from masiv.progress import silent


def learnt(seen, monkeypatch, errors, objectives, pictures=None):  # noqa: F811
    """The material that is kept, and those that were fitted. errors: of starts; objectives: of fits, None diverges;
    pictures: errors of what the last iterations make of each, None where there are no such iterations."""
    fitted, laws = [], {name: NeuralLaw(seed=k) for k, name in enumerate(errors)}
    problem = Problem(scene(), seen[0], settings(polish=False), SimulatorConfig())

    def fit(throws, law, *_, **__):
        name = next(name for name, known in laws.items() if known is law)
        fitted.append(name)
        if objectives[name] is None:
            raise MasivError("identify: the fit keeps diverging")
        return Fit(law, (throws[0].motion,), 0.01, objectives[name])

    starts = [Start(name, "sticky", laws[name], error) for name, error in errors.items()]
    monkeypatch.setattr(learn, "choose_start", lambda *_: starts)
    monkeypatch.setattr(learn, "fit", fit)
    if pictures is not None:
        by_objective = {objectives[name]: pictures[name] for name in pictures}
        monkeypatch.setattr(learn, "wanted", lambda _: True)
        monkeypatch.setattr(learn, "polish", lambda _, fitted, *__, **___: (fitted, by_objective[fitted.objective], {}))
    motion = InitialState.of_world(problem.axes, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    found = learn.learn([Throw(problem, motion, 3)], lambda: problem, 0, Checkpoint(None), silent)
    return found.report["start"], fitted


@pytest.mark.parametrize(
    ("errors", "objectives", "kept", "both"),
    [
        ({"honey": 0.1, "plasticine": 0.12}, {"honey": 0.3, "plasticine": 0.2}, "plasticine", True),
        ({"honey": 0.1, "plasticine": 0.12}, {"honey": 0.2, "plasticine": 0.3}, "honey", True),
        ({"honey": 0.1, "plasticine": 0.12}, {"honey": 0.2, "plasticine": None}, "honey", True),
        ({"honey": 0.1, "plasticine": 0.12}, {"honey": None, "plasticine": 0.3}, "plasticine", True),
        ({"honey": 0.1, "plasticine": 0.14}, {"honey": 0.3, "plasticine": 0.2}, "honey", False),
        # A yield that was not reached would be invented.
        ({"jelly": 0.1, "plasticine": 0.1}, {"jelly": 0.2, "plasticine": 0.19}, "jelly", True),
    ],
)
def test_the_better_of_two_fits_is_kept(seen, monkeypatch, errors, objectives, kept, both):  # noqa: F811
    found, fitted = learnt(seen, monkeypatch, errors, objectives)
    assert found == kept
    assert fitted == list(errors)[: 2 if both else 1]


def test_the_pictures_choose_where_they_have_the_last_word(seen, monkeypatch):  # noqa: F811
    starts, fits = {"honey": 0.1, "plasticine": 0.12}, {"honey": 0.3, "plasticine": 0.2}
    found, fitted = learnt(seen, monkeypatch, starts, fits, {"honey": 0.18, "plasticine": 0.19})
    assert found == "honey"
    assert fitted == ["honey", "plasticine"]


def test_where_every_fit_diverges_the_stage_says_so(seen, monkeypatch):  # noqa: F811
    with pytest.raises(MasivError, match="keeps diverging"):
        learnt(seen, monkeypatch, {"honey": 0.1, "plasticine": 0.12}, {"honey": None, "plasticine": None})
