"""The content of run.yaml, checked as strictly as a configuration: people edit the file. Light: no torch, no taichi."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from masiv.bounds import Fps
from masiv.config import Config, renamed_keys, without_removed_keys
from masiv.errors import InputError
from masiv.strict import validated

Count = Annotated[int, Field(ge=0, lt=2**31)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class StagePart(_Part):
    """state: what is left of the stage; seconds [s]: for how long it ran; started, finished: when; peak_memory_mb [MB]:
    what it took, with its processes; expected_memory_mb [MB]: what was said before it ran."""

    state: Literal["pending", "running", "done"]
    started: Any = None
    finished: Any = None
    seconds: Annotated[float, Field(ge=0)] = 0.0
    peak_memory_mb: Count = 0
    expected_memory_mb: Count = 0


class StagesPart(_Part):
    reconstruct: StagePart
    trajectory: StagePart
    identify: StagePart


class SplitPart(_Part):
    fit_frames: Count
    holdout_cameras: list[Count]


class ScenePart(BaseModel):
    """path, and what distinguishes the scene from others (``masiv.observations.identity``)."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    path: Annotated[str, Field(min_length=1)]
    layout: str | None = None
    fps: Fps | None = None
    frames: Annotated[int, Field(ge=2, lt=2**31)] | None = None


class RecordPart(BaseModel):
    """run.yaml, but for ``config``."""

    model_config = ConfigDict(extra="allow", strict=True)

    scene: ScenePart
    split: SplitPart
    config: dict[str, Any]
    stages: StagesPart


def check_record(record: dict[str, Any], where: Path) -> None:
    """Raises InputError, with the key, if ``record``, the content of the file ``where``, cannot be that of a run."""
    part = validated(RecordPart, record, str(where))
    validated(Config, without_removed_keys(renamed_keys(part.config)), f"{where}, section config")
    views, cameras = (part.scene.model_extra or {}).get("views"), part.split.holdout_cameras
    if isinstance(views, int) and any(camera >= views for camera in cameras):
        raise InputError(f"{where}: 'split.holdout_cameras' is {cameras}: the scene has cameras 0 to {views - 1}")
    frames = part.scene.frames
    if frames is not None and not 2 <= part.split.fit_frames <= frames:
        raise InputError(f"{where}: 'split.fit_frames' is {part.split.fit_frames}: the scene has {frames} frames")
