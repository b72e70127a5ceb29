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
    PresetOption,
    SceneArgument,
    SeedOption,
)


def reconstruct(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option("--out", help="Run folder, new or to go on with.", show_default=False)],
    fit_frames: FitFramesOption = None,
    holdout: HoldoutOption = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Dynamic Gaussians from video: gaussians.ply and deformation.safetensors in the run folder.

    Example: `masiv reconstruct scenes/bunny --out runs/bunny --preset quick --holdout-camera 3`
    """
    from . import stages
    from .console import progress_bar

    run, settings, read = stages.open_run(
        scene,
        out,
        preset=preset,
        config=config,
        seed=seed,
        arch=arch,
        fit_frames=fit_frames,
        holdout=holdout,
    )
    from masiv.report.numbers import reconstruction_numbers, table

    with progress_bar() as progress:
        dynamic = stages.reconstructed(run, settings, read, progress)
    numbers = reconstruction_numbers(run, read, dynamic)
    data = {
        "run": str(run.path),
        "gaussians": len(dynamic.canonical),
        "reconstruction": numbers,
        "seconds": run.seconds(),
    }
    return data, f"{run.path}: {len(dynamic.canonical)} Gaussians\n{table({'reconstruction': numbers})}"
