"""``masiv evaluate``: against ground truth, observed and future frames apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    ArchOption,
    ConfigOption,
    JsonOption,
    MovedSceneOption,
    PresetOption,
    RunArgument,
    SeedOption,
    SetOption,
    overrides,
)


def evaluate(
    run: RunArgument,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Folder with particles_F.npy, (P, 3) metres a frame; not for tracks."),
    ] = None,
    scene: MovedSceneOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Chamfer, tracked error, PSNR and SSIM, with rigid baselines; evaluate.json in the run folder.

    Example: `masiv evaluate runs/bunny --truth scenes/bunny/gt`

    Tracks: errors of the runs, those that were held out apart: `masiv evaluate runs/beam`
    """
    from masiv.pipeline import reopen_run

    from .console import progress_bar

    opened = reopen_run(run, overrides(preset, config, seed, arch, assignments), scene=scene)
    with progress_bar() as progress:
        result = opened.evaluate(truth, progress)
    return result.data, result.text
