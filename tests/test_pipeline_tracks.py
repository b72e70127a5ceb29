"""What refine leaves in the run folder of tracks: repeatable, reversible, and nothing outside of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from run_folder_page import missing

import masiv
from masiv.pipeline import Overrides, RefineRequest, SceneRequest, SimulateRequest
from masiv.pipeline.tracks import refine_stem

BALLS = Path(__file__).parent / "golden" / "balls"


@pytest.fixture
def run(tmp_path):
    opened = masiv.open_run(BALLS, tmp_path / "run")
    opened.identify()
    return opened


def effects(run) -> list[dict]:
    return yaml.safe_load((run.path / "twin.yaml").read_text())["effects"]


@pytest.mark.slow
def test_refining_again_gives_the_same_answer_and_the_same_twin(run):
    first = run.refine(RefineRequest(group=True)).data
    twin = effects(run)
    assert first["accepted"]
    assert twin
    again = run.refine(RefineRequest(group=True)).data
    assert again == first
    assert effects(run) == twin


@pytest.mark.slow
def test_an_answer_without_effects_restores_the_identified_twin(run, tmp_path):
    identified = effects(run)
    run.refine(RefineRequest(group=True))
    assert effects(run) != identified
    settings = tmp_path / "settings.yaml"
    settings.write_text(yaml.safe_dump({"refine": {"effects": ["swirl"], "min_predictive_p": 0}}))
    other = masiv.reopen_run(run.path, Overrides(config=settings))
    assert not other.refine(RefineRequest(group=True)).data["accepted"]
    assert effects(run) == identified


@pytest.mark.slow
def test_a_dry_run_leaves_an_earlier_result_alone(run):
    run.refine(RefineRequest(group=True))
    kept = {name: (run.path / name).read_bytes() for name in ("refine.json", "refine.npz", "twin.yaml", "report.html")}
    ranked = run.refine(RefineRequest(group=True, dry_run=True)).data
    assert ranked["candidates"]
    assert not ranked["accepted"]
    assert {name: (run.path / name).read_bytes() for name in kept} == kept
    assert json.loads((run.path / "refine.dry_run.json").read_text())["candidates"]


def content(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {str(p): (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.rglob("*") if p.is_file()}


def test_simulate_needs_no_scene_and_writes_nothing_into_the_run(run, tmp_path):
    run.simulate(SimulateRequest(4), tmp_path / "expected")
    alone = shutil.move(run.path, tmp_path / "elsewhere" / "run")
    before = content(alone)
    masiv.reopen_run(alone).simulate(SimulateRequest(4), tmp_path / "found")
    assert content(alone) == before
    expected, found = ((tmp_path / name / "rollout.npz").read_bytes() for name in ("expected", "found"))
    assert found == expected


def test_simulate_does_not_write_into_a_run_folder(run):
    before = content(run.path)
    with pytest.raises(masiv.InputError, match="is a run folder"):
        run.simulate(SimulateRequest(4), run.path)
    assert content(run.path) == before


def test_simulate_says_at_once_that_its_folder_cannot_be_made(run, tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper" / "out"):
        with pytest.raises(masiv.InputError, match=r"cannot be made: .*file is a file"):
            run.simulate(SimulateRequest(4), out)


def test_the_scene_of_a_moved_run_is_given_anew_and_remembered(run, tmp_path):
    alone = shutil.move(run.path, tmp_path / "elsewhere" / "run")
    with pytest.raises(masiv.InputError, match="say where it is with --scene"):
        masiv.reopen_run(alone).evaluate(None)
    with pytest.raises(masiv.InputError, match="not the scene of the run"):
        masiv.reopen_run(alone, scene=BALLS.parent / "bar").evaluate(None)
    with pytest.raises(masiv.InputError, match=r"--scene .*/none does not exist"):
        masiv.reopen_run(alone, scene=tmp_path / "none")
    numbers = masiv.reopen_run(alone, scene=BALLS).evaluate(None).data
    assert masiv.reopen_run(alone).evaluate(None).data == numbers


def test_the_page_names_every_file_and_key(run):
    run.refine(RefineRequest(group=True))
    run.refine(RefineRequest(group=True, dry_run=True))
    run.evaluate(None)
    assert missing(run.path, "tracks") == []


@pytest.mark.parametrize("condition", ["dry_run", "load.dry_run", ".", "..", "../x", "wind/2", "CON", "a:b"])
def test_no_condition_has_the_file_of_a_dry_run_or_leaves_the_folder(condition):
    stem = refine_stem(condition, "")
    assert stem not in {f"{refine_stem(other, '')}.dry_run" for other in ("", "load", condition)}
    assert not set(stem) & set('/\\:*?"<>|')
    assert stem.count(".") == 1


@given(st.text(min_size=1), st.text(min_size=1))
def test_a_condition_names_one_file_inside_the_run_folder(one, other):
    stems = [refine_stem(condition, "first condition") for condition in (one, other)]
    assert all(Path(f"{stem}.json").name == f"{stem}.json" for stem in stems)  # no separator in it
    assert (stems[0] == stems[1]) == (one == other)


@pytest.mark.parametrize(
    ("act", "option"),
    [
        (lambda run, out: masiv.open_run(BALLS, out, request=SceneRequest(fit_frames=3)), "--fit-frames"),
        (lambda run, out: masiv.open_run(BALLS, out, request=SceneRequest(holdout_camera=(0,))), "--holdout-camera"),
        (lambda run, out: masiv.open_run(BALLS, out, request=SceneRequest(no_silhouette=True)), "--no-silhouette"),
        (
            lambda run, out: masiv.open_run(BALLS, out, request=SceneRequest(keep_calibration=True)),
            "--keep-calibration",
        ),
        (lambda run, out: run.simulate(SimulateRequest(3, camera=("0",)), out), "--camera"),
        (lambda run, out: run.simulate(SimulateRequest(3, force_from=0.0), out), "--force-from"),
        (lambda run, out: run.refine(RefineRequest(second_run=out)), "--second-run"),
        (lambda run, out: run.evaluate(out), "--truth"),
    ],
)
def test_options_for_pictures_are_refused_and_leave_nothing(run, tmp_path, act, option):
    with pytest.raises(masiv.InputError, match=option):
        act(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()
