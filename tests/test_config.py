"""Order of the configuration's layers, and what a wrong key says."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

import pytest

from masiv.config import RENAMED_KEYS, Config, load_config, preset_overlay, renamed_keys
from masiv.errors import InputError


def write(tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    return path


def test_defaults_are_standard():
    assert load_config() == Config()
    assert load_config().preset == "standard"


@pytest.mark.parametrize("name", ["quick", "standard", "paper"])
def test_every_preset_is_valid(name):
    assert load_config(name).preset == name


def test_quick_is_less_work_than_paper():
    quick, paper = load_config("quick"), load_config("paper")
    assert quick.reconstruct.iterations < Config().reconstruct.iterations < paper.reconstruct.iterations
    assert quick.identify.iterations < paper.identify.iterations


def test_file_over_preset_and_flag_over_file(tmp_path):
    path = write(tmp_path, "seed: 3\narch: vulkan\npreset: quick\nreconstruct: {iterations: 7}")
    config = load_config(None, path, seed=5)
    assert (config.seed, config.arch, config.preset) == (5, "vulkan", "quick")
    assert config.reconstruct.iterations == 7
    untouched = {k: v for k, v in preset_overlay("quick").get("reconstruct", {}).items() if k != "iterations"}
    assert untouched.items() <= config.reconstruct.model_dump().items()


def test_a_run_is_the_base_unless_a_preset_is_asked_for(tmp_path):
    base = load_config(None, write(tmp_path, "seed: 9\ntrajectory: {iterations: 11}")).model_dump(mode="json")
    assert load_config(base=base).model_dump(mode="json") == base
    stale = {**base, "refine": {**base["refine"], "another": 1.0}}
    with pytest.raises(InputError, match=r"run.yaml of the run.*unknown key 'refine.another'"):
        load_config(base=stale)
    again = load_config("quick", base=base)
    assert again.seed == 9
    assert again.trajectory == load_config("quick").trajectory


@pytest.mark.parametrize("old", RENAMED_KEYS)
def test_keys_of_earlier_versions_are_read(tmp_path, old):
    section, key = old.split(".")
    new = RENAMED_KEYS[old]
    default = getattr(getattr(Config(), section), new)
    choices = get_args(type(getattr(Config(), section)).model_fields[new].annotation)
    value = not default if isinstance(default, bool) else 151
    if isinstance(default, float):
        value = 0.3 if default <= 1 else (default + 1) / 2  # within the bounds of every key
    value = choices[0] if choices else value
    from_file = load_config(None, write(tmp_path, f"{section}: {{{key}: {value}}}"))
    assert getattr(getattr(from_file, section), new) == value
    assert load_config(base={section: {key: value}}) == from_file
    assert renamed_keys({section: {key: 1, new: 2}}) == {section: {new: 2}}


def test_values_of_earlier_versions_are_read():
    old = {"identify": {"start": "honey", "contact": "slip"}}
    assert renamed_keys(old) == {"identify": {"start": "maxwell_fluid", "contact": "slip"}}
    assert old["identify"]["start"] == "honey"
    assert load_config(base=old).identify.start == "maxwell_fluid"
    current = Config().model_dump(mode="json")
    assert renamed_keys(current) == current


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reconstruct: {iteratons: 3}", "unknown key 'reconstruct.iteratons': did you mean 'reconstruct.iterations'"),
        ("simulater: {}", "did you mean 'simulator'"),
        ("seed: -1", "'seed' is -1"),
        ("reconstruct: 3", "'reconstruct' is 3"),
        ("preset: fast", "unknown preset 'fast'"),
        ("identify: {start: jely}", "'identify.start' is 'jely'"),
    ],
)
def test_bad_settings_say_which_key(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        load_config(None, write(tmp_path, text))
    assert message in str(error.value)


def test_light_modules_do_not_import_torch_or_taichi():
    code = (
        "import sys, masiv.config, masiv.cli.main, masiv.runfolder, masiv.observations.read\n"
        "assert not {'torch', 'taichi', 'matplotlib'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
