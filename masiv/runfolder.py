"""The run folder: names of its files, what was asked, and how far each stage is.

``run.yaml`` is written completely or not at all, so a killed run leaves a readable one. A stage that is
``running`` in it was interrupted or failed; starting it again goes on from its checkpoint.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError
from masiv.files import check_motion, read_npz, write_yaml
from masiv.strict import read_yaml, reason

SCHEMA = 1
STAGES = ("reconstruct", "trajectory", "identify")
# The parts of the configuration that change what a stage makes. Stages later in STAGES depend on all the earlier ones.
SECTIONS = {
    "reconstruct": ("reconstruct",),
    "trajectory": ("trajectory",),
    "identify": ("simulator", "identify", "tracks"),
}
MASKS = "masks"  # folder of masks that were estimated
PENDING, RUNNING, DONE = "pending", "running", "done"


@dataclass(frozen=True)
class Request:
    """What a run is asked: the resolved configuration (a plain mapping), the scene and the split."""

    config: Mapping[str, Any]
    scene_path: Path
    scene: Mapping[str, Any]  # masiv.observations.identity.identity
    fit_frames: int
    holdout_cameras: tuple[int, ...] = ()


@dataclass
class RunFolder:
    """A folder with the artefacts of one run. ``path`` must exist for everything but ``create_or_resume``."""

    path: Path
    record: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """An existing run. Raises InputError where ``path`` is none."""
        if not (path / "run.yaml").is_file():
            raise InputError(
                f"{path} is not a run folder (no run.yaml): make one with masiv reconstruct or masiv identify"
            )
        record = read_yaml(path / "run.yaml")
        if record.get("schema") != SCHEMA or not {"config", "scene", "split", "stages"} <= record.keys():
            raise InputError(
                f"{path / 'run.yaml'} was not written by this version of masiv: start a new run with --out"
            )
        from masiv.config import renamed_keys
        from masiv.run_record import check_record

        check_record(record, path / "run.yaml")
        record["config"] = renamed_keys(record["config"])
        return cls(path, record)

    @classmethod
    def create_or_resume(cls, path: Path, request: Request) -> RunFolder:
        """A new run, or an existing one that was asked the same. Raises InputError saying what differs."""
        if (path / "run.yaml").is_file():
            run = cls.open(path)
            run._accept(request)
        elif path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path} exists and is not a run folder: give another one with --out")
        else:
            run = cls(path, _new_record(request))
        run._write()
        return run

    # -- names --------------------------------------------------------------------------------------------------

    @property
    def scene_path(self) -> Path:
        return Path(self.record["scene"]["path"])

    @property
    def config(self) -> dict[str, Any]:
        return self.record["config"]

    @property
    def fit_frames(self) -> int:
        return self.record["split"]["fit_frames"]

    @property
    def holdout_cameras(self) -> tuple[int, ...]:
        return tuple(self.record["split"]["holdout_cameras"])

    @property
    def masks(self) -> Path:
        return self.path / MASKS

    @property
    def trajectory(self) -> Path:
        return self.path / "trajectory.npz"

    @property
    def rollout(self) -> Path:
        return self.path / "rollout.npz"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.json"

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluate.json"

    @property
    def log(self) -> Path:
        return self.path / "log.csv"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    # -- stages -------------------------------------------------------------------------------------------------

    def done(self, stage: str) -> bool:
        """Whether ``stage`` has left its artefacts."""
        return self.record["stages"][stage]["state"] == DONE

    def require(self, stage: str) -> None:
        """Raises InputError where ``stage`` has not been done."""
        if not self.done(stage):
            raise InputError(
                f"{self.path} has no finished {stage} stage: run masiv identify, which runs what is missing"
            )

    def checkpoint(self, stage: str) -> Checkpoint:
        """Where ``stage`` keeps its unfinished state."""
        return Checkpoint(self.path / "checkpoints" / f"{stage}.pt")

    @contextmanager
    def stage(self, stage: str) -> Iterator[Checkpoint]:
        """Record that ``stage`` runs, and on leaving without an error that it is done, and for how long it ran."""
        state = self.record["stages"][stage]
        state["state"] = RUNNING
        state.setdefault("started", _now())
        self._write()
        began = time.monotonic()
        checkpoint = self.checkpoint(stage)
        try:
            yield checkpoint
            state["state"], state["finished"] = DONE, _now()
        finally:
            state["seconds"] = round(state.get("seconds", 0.0) + time.monotonic() - began, 2)
            self._write()
        checkpoint.clear()

    def seconds(self) -> dict[str, float]:
        """What each finished stage took [s], interruptions not counted."""
        return {name: state["seconds"] for name, state in self.record["stages"].items() if state["state"] == DONE}

    # -- the record ---------------------------------------------------------------------------------------------

    def _begun(self, stage: str) -> bool:
        return self.record["stages"][stage]["state"] != PENDING

    def _accept(self, request: Request) -> None:
        asked = _new_record(request)
        differences = [
            f"scene {key} {self.record['scene'].get(key)!r} → {value!r}"
            for key, value in asked["scene"].items()
            if key != "path" and self.record["scene"].get(key) != value
        ]
        differences += [
            f"{key} {self.record['split'].get(key)!r} → {value!r}"
            for key, value in asked["split"].items()
            if self.record["split"].get(key) != value
        ]
        sections = [s for stage in STAGES if self._begun(stage) for s in SECTIONS[stage]]
        made_with = _with_defaults(self.config)
        for key in ["seed", *sections]:
            differences += _differences(key, made_with.get(key), asked["config"].get(key))
        if differences:
            raise InputError(
                f"{self.path} holds a run that was asked something else ({'; '.join(differences[:4])}"
                f"{'; …' if len(differences) > 4 else ''}): give another folder with --out, or the same settings"
            )
        self.record["config"] = asked["config"]
        self.record["scene"] = asked["scene"]
        self.record["versions"] = asked["versions"]

    def _write(self) -> None:
        write_yaml(self.path / "run.yaml", self.record)


def load_motion(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, Q, 3) float32 [m, world] and times (T,) [s] of a rollout.npz. Raises InputError."""
    try:
        file = read_npz(path)
        check_motion(file["positions"], file["times"])
    except (InputError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a rollout saved by masiv ({reason(error, path)})") from error
    return file["positions"], file["times"]


def _new_record(request: Request) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "created": _now(),
        "scene": {"path": str(request.scene_path.resolve()), **request.scene},
        "split": {"fit_frames": request.fit_frames, "holdout_cameras": list(request.holdout_cameras)},
        "config": dict(request.config),
        "versions": _versions(),
        "stages": {stage: {"state": PENDING} for stage in STAGES},
    }


def _with_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config`` with today's default for every key that masiv did not have when it was written."""
    from masiv.config import Config

    def over(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
        both = {key: over(low[key], high[key]) for key in low if isinstance(low[key], dict) and key in high}
        return {**low, **high, **both}

    return over(Config().model_dump(mode="json"), config)


def _differences(name: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        return [d for key in {**old, **new} for d in _differences(f"{name}.{key}", old.get(key), new.get(key))]
    unchanged = old == new or name.endswith(".processes")  # which leave every number as it is
    return [] if unchanged else [f"{name} {old!r} → {new!r}"]


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in ("masiv", "torch", "taichi", "numpy"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
