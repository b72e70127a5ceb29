"""The run folder: names of its files, what was asked, and how far each stage is.

``run.yaml`` is written completely or not at all, so a killed run leaves a readable one. A stage that is
``running`` in it was interrupted or failed; starting it again goes on from its checkpoint. Every file and key:
docs/run_folder.md.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError
from masiv.files import check_motion, read_npz, remove_temporary, write_yaml
from masiv.folder_lock import locked
from masiv.memory import PeakMemory
from masiv.scene.scene import Ground
from masiv.strict import read_yaml, reason

SCHEMA = 2
"""Format of the folder. In schema 1, paths of the scene and of other runs were absolute; it is read, too."""
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
        schema = record.get("schema")
        if isinstance(schema, int) and schema > SCHEMA:
            raise InputError(
                f"{path / 'run.yaml'} has schema {schema}, and this masiv reads 1 to {SCHEMA}: install a newer version"
            )
        if schema not in (1, SCHEMA) or not {"config", "scene", "split", "stages"} <= record.keys():
            raise InputError(
                f"{path / 'run.yaml'} was not written by this version of masiv: start a new run with --out"
            )
        from masiv.config import renamed_keys
        from masiv.run_record import check_record

        check_record(record, path / "run.yaml")
        record["config"] = renamed_keys(record["config"])
        return cls(path, _with_paths(record, lambda other: str((path.resolve() / other).resolve())))

    @classmethod
    def begun_in(cls, path: Path) -> RunFolder | None:
        """The run in ``path``; None if there is none, or if no stage of it has begun: it was refused, and what it was
        asked does not count. Raises InputError."""
        run = cls.open(path) if (path / "run.yaml").is_file() else None
        return run if run is not None and run.any_begun else None

    @classmethod
    def create_or_resume(cls, path: Path, request: Request) -> RunFolder:
        """A new run, or an existing one that was asked the same. Raises InputError saying what differs from what the
        stages that have begun were asked."""
        known = (path / "run.yaml").is_file()
        if not known and path.exists() and not _is_empty(path):
            raise InputError(f"{path} exists and is not a run folder: give another one with --out")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path} cannot be made: {error.strerror}; give another folder with --out") from error
        run = cls(path, _new_record(request))
        with run.locked():
            run.accept(request)
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run's lock, see ``masiv.folder_lock``, from the state in which the last process left the run."""
        with locked(self.path) as taken_over:
            if taken_over:
                remove_temporary(self.path)
            if (self.path / "run.yaml").is_file():
                self.record = RunFolder.open(self.path).record
            yield

    def accept(self, request: Request) -> None:
        """Record ``request``. Raises InputError if the run was asked something else, and says what differs."""
        asked = _new_record(request)
        if self.any_begun:
            self.check(request)
            asked = {key: asked[key] for key in ("schema", "config", "scene", "versions")}
        self.record |= asked
        self._write()

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
    def frame_count(self) -> int:
        """Frames of the scene, held-out ones included."""
        return self.record["scene"]["frames"]

    @property
    def times(self) -> np.ndarray:
        """(T,) [s] of the frames."""
        return np.arange(self.frame_count) / self.record["scene"]["fps"]

    @property
    def gravity(self) -> np.ndarray:
        """(3,) [m/s^2]."""
        return np.array(self.record["scene"]["gravity_m_s2"])

    @property
    def ground(self) -> Ground | None:
        ground = self.record["scene"]["ground"]
        return None if ground is None else Ground(np.array(ground["normal"]), ground["height_m"])

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
    def stage(self, stage: str, expected_mb: float = 0) -> Iterator[Checkpoint]:
        """Record that ``stage`` runs, and on leaving without an error that it is done; for how long it ran and the
        memory that it took with its processes. expected_mb [MB]: that it was expected to take; 0: it was not said."""
        state = self.record["stages"][stage]
        state["state"] = RUNNING
        state.setdefault("started", _now())
        if expected_mb:
            state["expected_memory_mb"] = round(expected_mb)
        self._write()
        began = time.monotonic()
        checkpoint = self.checkpoint(stage)
        memory = PeakMemory()
        try:
            with memory:
                yield checkpoint
            state["state"], state["finished"] = DONE, _now()
        finally:
            state["seconds"] = round(state.get("seconds", 0.0) + time.monotonic() - began, 2)
            state["peak_memory_mb"] = max(state.get("peak_memory_mb", 0), round(memory.bytes / 1e6))
            self._write()
        checkpoint.clear()

    def seconds(self) -> dict[str, float]:
        """What each finished stage took [s], interruptions not counted."""
        return {name: state["seconds"] for name, state in self.record["stages"].items() if state["state"] == DONE}

    # -- the record ---------------------------------------------------------------------------------------------

    @property
    def any_begun(self) -> bool:
        """Whether a stage has begun."""
        return any(map(self._begun, STAGES))

    def _begun(self, stage: str) -> bool:
        return self.record["stages"][stage]["state"] != PENDING

    def check(self, request: Request) -> None:
        """Raises InputError if the run was asked something else than ``request``, and says what differs."""
        self.check_scene(request.scene, request.scene_path)
        asked = _new_record(request)
        differences = [
            f"{key} {self.record['split'].get(key)!r} → {value!r}"
            for key, value in asked["split"].items()
            if self.record["split"].get(key) != value
        ]
        differences += self._changed_settings(asked["config"])
        if differences:
            raise InputError(
                f"{self.path} holds a run that was asked something else ({_first(differences)}): give another folder "
                "with --out, or the same settings"
            )

    def check_settings(self, config: Mapping[str, Any]) -> None:
        """Raises InputError if a stage that has begun was asked something else than ``config``."""
        if differences := self._changed_settings(config):
            raise InputError(f"{self.path} was made with other settings ({_first(differences)}): leave them out")

    def check_scene(self, scene: Mapping[str, Any], path: Path) -> None:
        """Raises InputError if ``scene`` (``masiv.observations.identity``), read from ``path``, is not the run's."""
        differences = [
            f"scene {key} {self.record['scene'].get(key)!r} → {value!r}"
            for key, value in scene.items()
            if self.record["scene"].get(key) != value
        ]
        if differences:
            raise InputError(
                f"{path} is not the scene of the run {self.path} ({_first(differences)}): give the run's scene, or "
                "another folder with --out"
            )

    def _changed_settings(self, config: Mapping[str, Any]) -> list[str]:
        """What differs between ``config`` and what the stages that have begun were asked."""
        made_with = _with_defaults(self.config)
        sections = [s for stage in STAGES if self._begun(stage) for s in SECTIONS[stage]]
        return [d for key in ["seed", *sections] for d in _differences(key, made_with.get(key), config.get(key))]

    def _write(self) -> None:
        folder = self.path.resolve()
        write_yaml(self.path / "run.yaml", _with_paths(self.record, lambda other: _relative(other, folder)))


def refuse_run(folder: Path, option: str) -> None:
    """Raises InputError if ``folder``, given with ``option``, is a run, of which a result would replace something."""
    if (folder / "run.yaml").exists():
        raise InputError(f"{option} {folder} is a run folder: give another one, so that nothing of the run is replaced")


def require_folder(folder: Path, option: str) -> None:
    """Raises InputError if ``folder``, given with ``option``, is a run, is no folder or cannot be made."""
    refuse_run(folder, option)
    present = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not present.is_dir() or not os.access(present, os.W_OK):
        kind = "a folder that you may not write to" if present.is_dir() else "a file"
        raise InputError(f"{option} {folder} cannot be made: {present} is {kind}; give another folder")


def load_motion(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, Q, 3) float32 [m, world] and times (T,) [s] of a rollout.npz. Raises InputError."""
    try:
        file = read_npz(path)
        check_motion(file["positions"], file["times"])
    except (InputError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a rollout saved by masiv ({reason(error, path)})") from error
    return file["positions"], file["times"]


def _is_empty(folder: Path) -> bool:
    """Whether ``folder`` is one with nothing in it but perhaps the lock of a run that was killed before it began."""
    return folder.is_dir() and all(path.name.startswith("lock.") for path in folder.iterdir())


def _first(differences: list[str]) -> str:
    return "; ".join(differences[:4]) + ("; …" if len(differences) > 4 else "")


def _relative(path: str, folder: Path) -> str:
    """``path`` as seen from ``folder``, so that both can be moved together."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return path


def _with_paths(record: Mapping[str, Any], convert: Callable[[str], str]) -> dict[str, Any]:
    """``record`` with ``convert`` applied to the paths in it: of the scene, and of other recordings of the object."""
    new = {**record, "scene": {**record["scene"], "path": convert(record["scene"]["path"])}}
    section = record["config"].get("identify")
    if section and section.get("also"):
        section = {**section, "also": [convert(path) for path in section["also"]]}
        new["config"] = {**record["config"], "identify": section}
    return new


def _new_record(request: Request) -> dict[str, Any]:
    record = {
        "schema": SCHEMA,
        "created": _now(),
        "scene": {"path": str(request.scene_path), **request.scene},
        "split": {"fit_frames": request.fit_frames, "holdout_cameras": list(request.holdout_cameras)},
        "config": dict(request.config),
        "versions": _versions(),
        "stages": {stage: {"state": PENDING} for stage in STAGES},
    }
    return _with_paths(record, lambda path: str(Path(path).resolve()))


def _with_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config`` with today's default for every key that masiv did not have when it was written."""
    from masiv.config import Config

    def over(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
        both = {key: over(low[key], high[key]) for key in low if isinstance(low[key], dict) and key in high}
        return {**low, **high, **both}

    return over(Config.model_validate({}).model_dump(mode="json"), config)


def _differences(name: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        return [d for key in {**old, **new} for d in _differences(f"{name}.{key}", old.get(key), new.get(key))]
    unchanged = old == new or name.endswith((".processes", ".scheduler"))  # which leave every number as it is
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
