"""What a batch is: scenes × laws × seeds × variants of settings. Light: no torch, no taichi."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, field_validator

from masiv.config import Preset, given_settings, load_config
from masiv.errors import InputError
from masiv.strict import read_yaml, validated
from masiv.tracks.read import can_read

T = TypeVar("T")
Settings = dict[str, Any]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)]
SHARED_WITH_LAWS = ("identify", "refine", "simulator", "tracks")
"""Sections of the configuration that leave a reconstruction and its trajectory as they are."""


class RefineOptions(BaseModel):
    """Options of ``masiv refine``. condition, group: of tracks."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    condition: str | None = None
    group: bool = False


class BatchSpec(BaseModel):
    """The YAML file of a batch; paths are relative to it.

    ``scenes``: folders, or patterns such as ``scenes/*``. ``law``, ``seed``: one or several. ``set``: settings of all
    runs (`masiv config` lists them); ``variants``: settings by name, one run each. ``preset``, ``fit_frames``,
    ``holdout_camera``, ``keep_calibration``: as the options of `masiv identify`. ``refine``: true, or its options.
    ``evaluate``: compare with the truth in SCENE/gt, where there is one.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenes: tuple[str, ...] = Field(min_length=1)
    law: tuple[str, ...] = ()
    seed: tuple[int, ...] = (0,)
    preset: Preset | None = None
    set: Settings = {}
    variants: dict[Name, Settings] = {}
    fit_frames: int | None = None
    holdout_camera: tuple[int, ...] = ()
    keep_calibration: bool = False
    refine: bool | RefineOptions = False
    evaluate: bool = False

    @field_validator("scenes", "law", "seed", mode="before")
    @classmethod
    def _one_or_several(cls, value: object) -> object:
        return value if isinstance(value, (list, tuple)) else (value,)

    @field_validator("law", "seed")
    @classmethod
    def _each_once(cls, value: tuple[T, ...]) -> tuple[T, ...]:
        if len(set(value)) < len(value):
            raise ValueError("a value is given twice: give each once")
        return value


@dataclass(frozen=True)
class Job:
    """One run of a batch. settings: assignments, "reconstruct.iterations=200"; law: None for the default of the kind of
    scene; variant: its name, empty if there is one alone."""

    name: str
    scene: Path
    pictures: bool
    law: str | None
    seed: int
    variant: str
    settings: tuple[str, ...]

    @property
    def before_laws(self) -> tuple[str, ...]:
        """The settings that reconstruction and trajectory depend on."""
        return tuple(s for s in self.settings if s.split(".", 1)[0].split("=", 1)[0] not in SHARED_WITH_LAWS)


def read_spec(path: Path) -> BatchSpec:
    """The spec in ``path``. Raises InputError for what is not valid."""
    return validated(BatchSpec, read_yaml(path), str(path))


def overridden(
    spec: BatchSpec, *, preset: str | None = None, config: Path | None = None, seed: int | None = None
) -> BatchSpec:
    """``spec`` with another preset, one seed in place of its own, and the settings of the YAML file ``config`` under
    its own. Raises InputError."""
    given = {} if config is None else given_settings(config)
    changes: Settings = {"set": {**given, **spec.set}}
    changes |= {} if preset is None else {"preset": preset}
    changes |= {} if seed is None else {"seed": (seed,)}
    return validated(BatchSpec, {**spec.model_dump(), **changes}, "the command line")


def jobs_of(spec: BatchSpec, folder: Path, where: Path, more: Sequence[str] = ()) -> tuple[Job, ...]:
    """The runs of ``spec``, whose paths are relative to ``folder``; more: assignments over its settings. Every setting
    is checked. Raises InputError that names the file ``where``."""
    scenes = _scenes(spec, folder, where)
    names = _unique([scene.name for scene in scenes])
    variants: Mapping[str, Settings] = spec.variants or {"": {}}
    laws: Sequence[str | None] = spec.law or (None,)
    jobs = []
    for (scene, name), law, seed, (variant, own) in itertools.product(
        zip(scenes, names, strict=True), laws, spec.seed, variants.items()
    ):
        parts = [name, law if len(laws) > 1 else None, f"seed{seed}" if len(spec.seed) > 1 else None, variant]
        settings = _assignments(spec.set, f"{where}: set") + _assignments(own, f"{where}: variants.{variant}")
        settings = (*settings, *more)
        flags: dict[str, Any] = {"seed": seed, "identify.law": law}
        load_config(spec.preset, assignments=settings, **flags)
        given = given_settings(assignments=settings)
        if law is not None and "law" in given.get("identify", {}):
            raise InputError(f"{where}: identify.law is among the settings, and law is given: keep one of them")
        for key in ("seed", "preset", "arch"):
            if key in given:
                raise InputError(f"{where}: {key} is among the settings: give it as {key}, or as --{key}")
        jobs.append(
            Job("-".join(p for p in parts if p), scene, not can_read(scene), law, seed, variant, settings)
        )  # fmt: skip
    return tuple(jobs)


def _scenes(spec: BatchSpec, folder: Path, where: Path) -> list[Path]:
    found: dict[Path, None] = {}
    for pattern in spec.scenes:
        if any(letter in pattern for letter in "*?["):
            root = Path(pattern).anchor or folder
            matches = sorted(
                p for p in Path(root).glob(str(Path(pattern)).removeprefix(Path(pattern).anchor)) if p.is_dir()
            )
            if not matches:
                raise InputError(f"{where}: scenes: no folder matches {pattern}")
        else:
            matches = [folder / pattern]
            if not matches[0].exists():
                raise InputError(f"{where}: scenes: {matches[0]} does not exist: give the folder of a scene")
        found |= dict.fromkeys(path.resolve() for path in matches)
    return list(found)


def _unique(names: Sequence[str]) -> list[str]:
    """Names of folders, with a number where two are alike."""
    out: list[str] = []
    for name in names:
        clean = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
        candidate, number = clean, 2
        while candidate in out:
            candidate, number = f"{clean}_{number}", number + 1
        out.append(candidate)
    return out


def _assignments(settings: Settings, where: str) -> tuple[str, ...]:
    """``settings``, whose keys are dotted names or nested mappings, as assignments."""
    out = []
    for key, value in settings.items():
        if isinstance(value, dict):
            out += [f"{key}.{inner}" for inner in _assignments(value, where)]
        else:
            text = yaml.safe_dump(value, default_flow_style=True, width=10**6).strip().removesuffix("...").strip()
            out.append(f"{key}={text}")
    return tuple(out)
