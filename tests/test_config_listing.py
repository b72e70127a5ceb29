"""What ``masiv config`` prints, and settings given one by one (--set)."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
import typer
import yaml
from small_run import write_run, write_scene

import masiv
from masiv.cli import main
from masiv.config import Config, dotted_keys, load_config, nearest_key
from masiv.config_listing import as_yaml, listing
from masiv.errors import InputError
from masiv.pipeline import Overrides

ROOT = Path(__file__).parents[1]
PRESETS = ("quick", "standard", "paper")
COMMANDS = typer.main.get_command(main.app).commands  # type: ignore[attr-defined]
UNIT_IN_NAME = {"deg": "degrees", "px": "pixels", "mb": "MB", "frames": "frames", "duration": "s"}


def value_of(config, key):
    for part in key.split("."):
        config = getattr(config, part)
    return config


@pytest.mark.parametrize("preset", PRESETS)
def test_every_key_has_its_value_and_a_description(preset):
    config = load_config(preset)
    settings = listing(config)
    assert [s.key for s in settings] == list(dotted_keys())
    assert {s.key.split(".")[0] for s in settings} == set(Config.model_fields)
    for setting in settings:
        assert setting.value == value_of(config, setting.key) or isinstance(setting.value, list)
        assert len(setting.description) > 10, setting.key


def test_a_name_that_holds_a_unit_agrees_with_the_unit():
    settings = listing(Config())
    for setting in settings:
        last = setting.key.rsplit("_", 1)[-1].rsplit(".", 1)[-1]
        if last in UNIT_IN_NAME:
            assert setting.unit == UNIT_IN_NAME[last], setting.key
    assert next(s for s in settings if s.key == "identify.velocity_learning_rate").unit == "m/s, rad/s"


@pytest.mark.parametrize("key", ["courant_number", "ground_range"])
def test_bounds_are_those_of_the_validation(key):
    """At a bound that is printed a value is taken if the sign allows it, and refused beyond it."""
    setting = next(s for s in listing(Config()) if s.key.endswith(key))
    assert setting.bounds
    for sign, limit in re.findall(r"([≥>≤<]) ([\d.]+)", setting.bounds):
        outward = -1 if sign in "≥>" else 1
        if sign in "≥≤":
            assert value_of(load_config(assignments=[f"{setting.key}={limit}"]), setting.key) == float(limit)
        with pytest.raises(InputError, match=setting.key):
            load_config(assignments=[f"{setting.key}={float(limit) + outward * 1e-6}"])


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_printed_is_read_back(tmp_path, preset):
    given = [
        "seed=7",
        "trajectory.symmetry=[0, 1, 0.5]",
        "identify.also=[a b, 'c: d']",
        "trajectory.learning_rate=1e-7",
    ]
    for config in (load_config(preset), load_config(preset, assignments=given)):
        path = tmp_path / "settings.yaml"
        path.write_text(as_yaml(listing(config)), encoding="utf-8")
        assert load_config(None, path) == config


def test_a_section_is_printed_with_its_place(tmp_path):
    settings = listing(load_config("quick"), "reconstruct.calibration")
    printed = yaml.safe_load(as_yaml(settings))
    assert list(printed) == ["reconstruct"]
    assert list(printed["reconstruct"]) == ["calibration"]
    assert printed["reconstruct"]["calibration"]["rotation_deg"] == 0.3
    assert [s.key for s in listing(Config(), "seed")] == ["seed"]
    with pytest.raises(InputError, match=r"did you mean 'reconstruct.calibration'"):
        listing(Config(), "reconstruct.calibraton")


def test_each_key_stands_below_its_own_comment():
    lines = as_yaml(listing(Config())).splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        if not line.lstrip().startswith("#") and not line.endswith(":"):
            assert above.lstrip().startswith("#"), line
    assert max(map(len, lines)) <= 120


def test_later_layers_replace_earlier_ones(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("preset: quick\nseed: 1\nreconstruct: {iterations: 11, width: 12}")
    config = load_config(None, path, None, ["reconstruct.iterations=22", "seed=2"], seed=3)
    assert (config.reconstruct.iterations, config.reconstruct.width, config.seed) == (22, 12, 3)
    assert config.trajectory == load_config("quick").trajectory
    assert load_config(None, path, None, ["preset=paper"]).trajectory == load_config("paper").trajectory
    assert load_config("standard", path, None, ["preset=paper"]).trajectory == Config().trajectory
    assert load_config(assignments=["identify.iterations=1", "identify.iterations=2"]).identify.iterations == 2
    assert load_config(assignments=["reconstruct.calibration.rotation_deg=2"]).reconstruct.calibration.log_gain == 0.05
    base = load_config("quick").model_dump(mode="json")
    assert load_config(base=base, assignments=["seed=4"]).model_dump(mode="json") == {**base, "seed": 4}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reconstruct.iteratons=3", "unknown key 'reconstruct.iteratons': did you mean 'reconstruct.iterations'"),
        ("iterations=3", "did you mean 'identify.iterations'"),
        ("reconstruct.calibration.rotatoin_deg=3", "did you mean 'reconstruct.calibration.rotation_deg'"),
        ("reconstruct={iteratons: 3}", "did you mean 'reconstruct.iterations'"),
        ("reconstruct.iterations=many", "'reconstruct.iterations' is 'many'"),
        ("reconstruct.iterations=0", "greater than or equal to 1"),
        ("reconstruct.scale_rate=.nan", "'reconstruct.scale_rate' is nan"),
        ("reconstruct.iterations", "give a key and its value"),
        ("=3", "give a key and its value"),
        ("seed=", "give a key and its value"),
        ("seed.more=3", "did you mean 'seed'"),
        ("reconstruct=3", "'reconstruct' is 3"),
        ("seed={a: 1", "not valid YAML"),
        ("preset=fast", "fast"),
        ("refine.min_bic_gain=3", "unknown key 'refine.min_bic_gain'"),
        (".".join("a" * 2000) + "=1", "unknown key"),
        ("seed=" + "[" * 5000, "--set"),
    ],
)
def test_a_bad_assignment_names_the_option(text, message):
    with pytest.raises(InputError) as error:
        load_config(assignments=[text])
    assert str(error.value).startswith("--set ")
    assert message in str(error.value)
    assert len(str(error.value)) < 600


def test_keys_of_earlier_versions_are_read():
    assert load_config(assignments=["reconstruct.pictures=5"]).reconstruct.batch_size == 5
    assert nearest_key("reconstruct.calibratio") == "reconstruct.calibration"


def test_every_command_with_a_configuration_takes_single_settings():
    options = {name: {o for p in command.params for o in p.opts} for name, command in COMMANDS.items()}
    taking = [name for name, known in options.items() if "--config" in known]
    assert {"identify", "refine", "simulate", "evaluate", "pretrain", "synth", "config"} <= set(taking)
    assert all("--set" in options[name] for name in taking)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """What stands for the arguments of commands, by the name that their help gives them."""
    folder = tmp_path_factory.mktemp("given")
    write_run(folder / "run")
    scene = write_scene(folder / "scene")
    return {"SCENE": scene, "RUN": folder / "run", "MATERIAL": "jelly", "SPEC.yaml": ROOT / "assets/sample.yaml"}


@pytest.mark.parametrize("name", [n for n, c in COMMANDS.items() if any("--set" in p.opts for p in c.params)])
def test_every_command_refuses_an_unknown_setting(monkeypatch, capsys, tmp_path, given, name):
    needed: list[str] = []
    for parameter in COMMANDS[name].params:
        if parameter.required and parameter.param_type_name == "argument":
            needed.append(str(given.get(parameter.metavar, tmp_path / "none")))
        elif parameter.required:
            needed += [parameter.opts[0], "3"]
    monkeypatch.setattr(sys, "argv", ["masiv", name, *needed, "--set", "identify.iteratons=3"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main.run()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.startswith("error: --set identify.iteratons=3: unknown key") or str(tmp_path / "none") in needed
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_a_run_remembers_what_was_set(tmp_path, given):
    overrides = Overrides("quick", assignments=("reconstruct.iterations=77",))
    masiv.open_run(given["SCENE"], tmp_path / "run", overrides)
    kept = yaml.safe_load((tmp_path / "run/run.yaml").read_text(encoding="utf-8"))["config"]
    assert kept["reconstruct"]["iterations"] == 77
    assert masiv.reopen_run(tmp_path / "run").config == load_config("quick", assignments=overrides.assignments)


def test_the_command_prints_yaml_and_json(monkeypatch, capfd):
    def printed(*arguments):
        monkeypatch.setattr(sys, "argv", ["masiv", "config", *arguments])
        with pytest.raises(SystemExit) as ended:
            main.run()
        assert ended.value.code == 0
        return capfd.readouterr().out

    text = printed("--preset", "quick", "--set", "tracks.duration=2")
    assert Config.model_validate(yaml.safe_load(text)) == load_config("quick", assignments=["tracks.duration=2"])
    settings = json.loads(printed("--json", "tracks.duration"))["settings"]
    assert [(s["key"], s["value"], s["unit"]) for s in settings] == [("tracks.duration", 1.0, "s")]
    assert settings[0]["bounds"] == "> 0"
