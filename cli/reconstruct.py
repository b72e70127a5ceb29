"""``masiv reconstruct``: dynamic Gaussians from video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    ArchOption,
    ConfigOption,
    FitFramesOption,
    HoldoutOption,
    JsonOption,
    KeepCalibrationOption,
    PresetOption,
    SceneArgument,
    SeedOption,
    SetOption,
    overrides,
)


def reconstruct(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option("--out", help="Run folder, new or to go on with.", show_default=False)],
    fit_frames: FitFramesOption = None,
    holdout: HoldoutOption = None,
    keep_calibration: KeepCalibrationOption = False,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Dynamic Gaussians from video: gaussians.ply and deformation.safetensors in the run folder.

    Example: `masiv reconstruct scenes/bunny --out runs/bunny --preset quick --holdout-camera 3`
    """
    from masiv.pipeline import SceneRequest, open_run

    from .console import progress_bar

    request = SceneRequest(fit_frames, tuple(holdout or ()), keep_calibration=keep_calibration)
    run = open_run(scene, out, overrides(preset, config, seed, arch, assignments), request)
    with progress_bar() as progress:
        result = run.reconstruct(progress)
    return result.data, result.text
