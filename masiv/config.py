"""The whole configuration. Order: defaults < preset < --config < --set < flags. Light: no torch, no taichi."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from masiv.continuum.config import TrajectoryConfig
from masiv.errors import InputError
from masiv.identification.config import RENAMED_STARTS, IdentifyConfig
from masiv.mpm.config import SimulatorConfig
from masiv.refinement.config import REMOVED_KEYS as REFINE_REMOVED_KEYS
from masiv.refinement.config import RENAMED_KEYS as REFINE_RENAMED_KEYS
from masiv.refinement.config import RefineConfig
from masiv.splat.config import ReconstructConfig
from masiv.strict import parsed_yaml, quoted, read_yaml, shortened, validated
from masiv.tracks.config import TracksConfig

RENAMED_KEYS = {
    "reconstruct.pictures": "batch_size",
    "reconstruct.first_frame_share": "first_frame_fraction",
    "reconstruct.growth_share": "growth_fraction",
    "reconstruct.followed_rate": "canonical_rate_factor",
    "reconstruct.final_rate": "final_rate_factor",
    "trajectory.carve_misses": "carve_images",
    "trajectory.batch": "batch_size",
    "trajectory.match_every": "match_interval",
    "simulator.split": "subparticles",
    "identify.polish": "surface_finetune",
    "identify.polish_silhouette_weight": "finetune_silhouette_weight",
    "identify.paint_weight": "color_weight",
    "identify.polish_paint_weight": "finetune_color_weight",
    "tracks.highest_poissons_ratio": "max_poissons_ratio",
    **{f"refine.{old}": new for old, new in REFINE_RENAMED_KEYS.items()},
}
"""Keys of earlier versions: section and old name -> new name in the same section."""
REMOVED_KEYS = tuple(f"refine.{name}" for name in REFINE_REMOVED_KEYS)
"""Keys of earlier versions that nothing stands for: in the configuration of a run they are left out."""
RENAMED_VALUES = {"identify.start": RENAMED_STARTS}
"""Values of earlier versions by section and key: old value -> new value."""

LONGEST_KEY = 100
"""Characters of a key that are compared with known ones."""

Preset = Literal["quick", "standard", "paper"]
DEFAULT_PRESET = "standard"


class Config(BaseModel):
    """What a run is asked to do. ``arch`` is where kernels run, ``processes`` in how many processes, and
    ``memory_limit_mb`` whether a stage starts; every other key may change the numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    preset: Preset = Field(DEFAULT_PRESET, description="the settings that all others start from")
    seed: int = Field(0, ge=0, lt=2**31, description="seed of every random number")
    arch: Literal["cpu", "cuda", "vulkan"] = Field("cpu", description="where Taichi runs its kernels")
    memory_limit_mb: int = Field(
        0, ge=0, lt=2**31,
        description="memory that a stage may take [MB]: one that is expected to take more does not start; 0: what the "
        "machine has left",
    )  # fmt: skip
    reconstruct: ReconstructConfig = ReconstructConfig.model_validate({})
    trajectory: TrajectoryConfig = TrajectoryConfig.model_validate({})
    simulator: SimulatorConfig = SimulatorConfig.model_validate({})
    identify: IdentifyConfig = IdentifyConfig.model_validate({})
    refine: RefineConfig = RefineConfig.model_validate({})
    tracks: TracksConfig = TracksConfig.model_validate({})


def load_config(
    preset: str | None = None,
    path: Path | None = None,
    base: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
    **flags: int | float | str | list[str] | None,
) -> Config:
    """The configuration from a preset, a YAML file, assignments and flags (None: not given); flag "identify.law" is a
    nested key.

    An assignment is text, "reconstruct.iterations=200", with the value in YAML; the last one of a key counts.
    ``base`` is the configuration of an existing run. It takes the place of the defaults; under a preset that
    is given, only its seed and arch do.
    Raises InputError for an unknown preset or key, naming the nearest known one, and for a value out of range.
    """
    given = given_settings(path, assignments)
    name = preset or given.get("preset")
    merged: dict[str, Any] = without_removed_keys(renamed_keys(base or {}))
    if name is not None or base is None:
        kept = {key: merged[key] for key in ("seed", "arch") if key in merged}
        merged = {**kept, **preset_overlay(str(name or DEFAULT_PRESET))}
    else:  # a key of an earlier version is the run's, not of what is given now
        validated(Config, merged, "run.yaml of the run, section config")
    merged = _merged(merged, given)
    if preset is not None:
        merged["preset"] = preset
    for key, value in flags.items():
        if value is not None:
            _check_flag(key, value)
            merged = _merged(merged, _nested(key, value))
    return validated(Config, merged, "the command line" if path is None else str(path))


def given_settings(path: Path | None = None, assignments: Sequence[str] = ()) -> dict[str, Any]:
    """The keys that a YAML file and assignments set, the latter over the former. Raises InputError for a file that is
    no YAML and for an assignment that the configuration would not take; it names --set and the nearest known key."""
    given = {} if path is None else renamed_keys(read_yaml(path))
    for text in assignments:
        given = _merged(given, _assigned(text))
    return given


def _assigned(text: str) -> dict[str, Any]:
    """``key=value`` as a nested mapping that is valid."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise InputError(
            f"--set {quoted(text)}: give a key and its value, for example --set reconstruct.iterations=200"
        )
    where = f"--set {shortened(text)}"
    if key not in (*_keys_and_sections(), *RENAMED_KEYS):
        raise InputError(f"{where}: unknown key '{shortened(key)}': did you mean '{nearest_key(key)}'?")
    setting = renamed_keys(_nested(key, parsed_yaml(value, where)))
    validated(Config, setting, where)
    return setting


def dotted_keys(model: type[BaseModel] = Config, above: str = "") -> Iterator[str]:
    """Every key of the configuration as --set takes it: "seed", "reconstruct.calibration.rotation_deg" …"""
    for name, field in model.model_fields.items():
        nested = field.annotation
        if isinstance(nested, type) and issubclass(nested, BaseModel):
            yield from dotted_keys(nested, f"{above}{name}.")
        else:
            yield above + name


def nearest_key(key: str) -> str:
    """The key or section of the configuration whose dotted name is most like ``key``."""
    return difflib.get_close_matches(key[:LONGEST_KEY], _keys_and_sections(), n=1, cutoff=0.0)[0]


def _keys_and_sections() -> list[str]:
    keys = list(dotted_keys())
    return [*keys, *sorted({key[:end] for key in keys for end, letter in enumerate(key) if letter == "."})]


def _check_flag(key: str, value: object) -> None:
    """Raises InputError that names the option if ``value`` cannot be that of the nested ``key``."""
    try:
        Config.model_validate(_nested(key, value))
    except ValidationError as error:
        name, message = key.split(".")[-1], error.errors()[0]["msg"]
        raise InputError(
            f"--{name.replace('_', '-')} {quoted(value)}: {message[:1].lower() + message[1:]} (see --help)"
        ) from error


def _nested(key: str, value: object) -> dict[str, Any]:
    """A mapping in which ``value`` has the dotted ``key``."""
    *sections, name = key.split(".")
    nested: dict[str, Any] = {name: value}
    for section in reversed(sections):
        nested = {section: nested}
    return nested


def renamed_keys(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config``, of a run or a file of this or an earlier version, with the present names of its keys and values."""
    result = {key: dict(value) if isinstance(value, Mapping) else value for key, value in config.items()}
    for old, new in RENAMED_KEYS.items():
        section, key = old.split(".")
        values = result.get(section)
        if isinstance(values, dict) and key in values:
            values.setdefault(new, values.pop(key))
    for name, renamed in RENAMED_VALUES.items():
        section, key = name.split(".")
        values = result.get(section)
        if isinstance(values, dict) and isinstance(value := values.get(key), str) and value in renamed:
            values[key] = renamed[value]
    return result


def without_removed_keys(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config`` of a run of this or an earlier version, without keys that mean nothing any more."""
    removed = {tuple(name.split(".")) for name in REMOVED_KEYS}
    return {
        section: {k: v for k, v in values.items() if (section, k) not in removed}
        if isinstance(values, Mapping)
        else values
        for section, values in config.items()
    }


def preset_overlay(name: str) -> dict[str, Any]:
    """The keys that preset ``name`` sets. Raises InputError for an unknown name."""
    if name not in get_args(Preset):
        raise InputError(f"unknown preset '{name}' (--preset): use one of {', '.join(get_args(Preset))}")
    text = files("masiv.presets").joinpath(f"{name}.yaml").read_text(encoding="utf-8")
    return {"preset": name, **(yaml.safe_load(text) or {})}


def _merged(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    """``high`` over ``low``, mapping by mapping."""
    result = dict(low)
    for key, value in high.items():
        below = result.get(key)
        result[key] = _merged(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return result
