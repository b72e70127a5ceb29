"""One law fitted to several recordings of a body."""

import dataclasses

import numpy as np
import pytest
import torch
from cube import FRAMES, OMEGA, VELOCITY, VOLUME, Seen, motion_of, scene, settings
from small import SMALL

from masiv.checkpoint import Checkpoint
from masiv.cli.main import run
from masiv.config import load_config
from masiv.errors import InputError
from masiv.identification.neural.training import train
from masiv.identification.neural.training_state import TrainingState
from masiv.identification.recording import prepare_recording
from masiv.identification.stage import identify
from masiv.materials.classical import ClassicalLaw
from masiv.materials.load import load_law
from masiv.pretraining.pretrain import pretrained_path
from masiv.runfolder import Request, RunFolder

DROP = np.array([-0.3, -2.5, 0.1])
"""A faster release [m/s], which deforms the body more."""


@pytest.fixture(scope="module")
def dropped(taichi):
    """Another recording of the body of ``seen``."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3)
    motion = motion_of(law, FRAMES - 1, DROP, -OMEGA)  # one frame fewer: films differ in length
    return Seen(motion.positions, motion.times, VOLUME)


def recordings_of(seen, dropped, config):
    shorter = dataclasses.replace(scene(), frame_count=FRAMES - 1)
    films = (scene(), seen[0]), (shorter, dropped)
    return [prepare_recording(*film, config, SMALL)[0] for film in films]


def stiffer(factor):
    law = load_law(pretrained_path("jelly"))
    with torch.no_grad():
        law.log_stress_scale += np.log(factor * 4e4 / law.wave_modulus())
    return law


def fitted(recordings, law=None):
    start = law or stiffer(2.0)
    return train(recordings, start, "sticky", seed=0, checkpoint=Checkpoint(None), progress=lambda *_: None)


@pytest.mark.slow
def test_a_law_of_two_recordings_explains_both(seen, dropped):
    both = recordings_of(seen, dropped, settings(iterations=14))
    start = fitted(recordings_of(seen, dropped, settings(iterations=0)))
    end = fitted(both)
    assert end.trajectory_error < 0.4 * start.trajectory_error
    with torch.no_grad():
        errors = [
            float(r.objective.trajectory_errors(r.objective.whole_rollout(end.law, state, "sticky")).mean())
            for r, state in zip(both, end.initial_states, strict=True)
        ]
    assert max(errors) < 0.01
    assert end.trajectory_error == pytest.approx(np.mean(errors), rel=1e-4)
    for state, velocity in zip(end.initial_states, (VELOCITY, DROP), strict=True):
        np.testing.assert_allclose(state.velocity.numpy(), velocity, atol=0.1)


def test_each_recording_has_the_same_weight(seen, dropped, monkeypatch):
    """A step from the same recording twice equals that from it once (later ones differ: gradients of initial states
    are clipped)."""
    gradients = []
    of_law = len(list(stiffer(1.0).parameters()))
    with monkeypatch.context() as patched:
        patched.setattr(
            TrainingState, "step", lambda self, _: gradients.append([p.grad.clone() for p in self._parameters[:of_law]])
        )
        one = recordings_of(seen, dropped, settings(iterations=1))[:1]
        fitted(one)
        fitted(one * 2)
    for once, twice in zip(*gradients, strict=True):
        torch.testing.assert_close(twice, once, rtol=1e-4, atol=1e-7)
    one = recordings_of(seen, dropped, settings(iterations=2))[:1]
    once, twice = fitted(one), fitted(one * 2)
    assert once.objective < fitted(one, law=stiffer(3.0)).objective
    assert twice.objective == pytest.approx(once.objective, rel=1e-5)
    assert twice.law.wave_modulus() == pytest.approx(once.law.wave_modulus(), rel=1e-4)
    assert once.law.wave_modulus() != pytest.approx(stiffer(2.0).wave_modulus(), rel=1e-2)


@pytest.mark.slow
def test_a_stage_that_is_killed_goes_on_with_all_recordings(seen, dropped, tmp_path):
    class Stop(Exception):
        pass

    def stops(stage, done, *_):
        if stage == "identify: fit" and done == 2:
            raise Stop

    config = settings(iterations=3)
    more = {"others": [(dataclasses.replace(scene(), frame_count=FRAMES - 1), dropped)]}
    whole = identify(scene(), seen[0], config, SMALL, **more)
    assert whole.fit["recordings"] == 2
    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(scene(), seen[0], config, SMALL, **more, checkpoint=Checkpoint(path, every_s=0),
                 progress=stops)  # fmt: skip
    resumed = identify(scene(), seen[0], config, SMALL, **more, checkpoint=Checkpoint(path, every_s=0))
    assert resumed.fit == whole.fit
    assert all(torch.equal(a, b) for a, b in zip(whole.law.parameters(), resumed.law.parameters(), strict=True))
    with pytest.raises(InputError, match="fitted to one recording"):
        identify(scene(), seen[0], settings(law="neo_hookean"), SMALL, **more)


def test_other_recordings_are_checked_before_anything_is_made(tmp_path, capsys, monkeypatch):
    scene_path, out = "assets/sample", tmp_path / "run"
    for options, said in (
        (["--also", str(tmp_path / "none")], "is not a run folder"),
        (["--also", str(out)], "is the run itself"),
        (["--also", str(tmp_path / "none"), "--law", "newtonian"], "fitted to one recording"),
    ):
        monkeypatch.setattr("sys.argv", ["masiv", "identify", scene_path, "--out", str(out), *options])
        with pytest.raises(SystemExit) as left:
            run()
        assert left.value.code == 2
        assert said in " ".join(capsys.readouterr().err.split())
        assert not out.exists()
    unfinished = tmp_path / "unfinished"
    RunFolder.create_or_resume(unfinished, Request(load_config().model_dump(mode="json"), tmp_path, {}, 2))
    monkeypatch.setattr("sys.argv", ["masiv", "identify", scene_path, "--out", str(out), "--also", str(unfinished)])
    with pytest.raises(SystemExit):
        run()
    assert "no finished trajectory stage" in " ".join(capsys.readouterr().err.split())
