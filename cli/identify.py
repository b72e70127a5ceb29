"""``masiv identify``: the main job, from video to twin."""

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


def identify(
    scene: SceneArgument,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder. [default: runs/SCENE]")] = None,
    law: Annotated[
        str | None,
        typer.Option(
            "--law",
            help="What is fitted: neural, adapter (a correction of a classical law), neo_hookean, newtonian, "
            "non_newtonian, von_mises, drucker_prager, or auto (the classical law that explains the motion best). "
            "[default: neural]",
        ),
    ] = None,
    also: Annotated[
        list[Path] | None,
        typer.Option(
            "--also",
            help="Run folder of another recording of the same object, made by masiv trajectory: a neural law is fitted "
            "to all of them. May be given several times.",
        ),
    ] = None,
    geometry_loss: Annotated[
        str | None,
        typer.Option(
            "--geometry-loss",
            help="What a neural law is fitted to: trajectory (paths of particles, then surfaces; paths alone with "
            "identify.surface_finetune: false), continuum (bodies frame by frame), surface, or none (pictures alone). "
            "[default: trajectory]",
        ),
    ] = None,
    no_silhouette: Annotated[
        bool, typer.Option("--no-silhouette", help="Fit a neural law to geometry alone, without the pictures.")
    ] = False,
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
    """From video to twin: runs every stage that the run folder lacks, then writes rollout, numbers and a report.

    Example: `masiv identify scenes/bunny --out runs/bunny --preset quick --fit-frames 12`

    A scene of tracks (measured points, no pictures) starts with the law: `masiv identify scenes/beam`

    One law from several recordings: `masiv identify scenes/egg_1 --out runs/egg_1 --also runs/egg_2 --also runs/egg_3`

    A classical baseline: `masiv identify scenes/bunny --out runs/bunny-elastic --law neo_hookean`
    """
    from masiv.pipeline import SceneRequest, open_run

    from .console import progress_bar

    asked = {
        "law": law,
        "also": [str(path.resolve()) for path in also] if also else None,
        "geometry_loss": geometry_loss,
        "pictures": 0 if no_silhouette else None,
    }
    request = SceneRequest(fit_frames, tuple(holdout or ()), asked, no_silhouette, keep_calibration)
    run = open_run(scene, out, overrides(preset, config, seed, arch, assignments), request)
    with progress_bar() as progress:
        result = run.identify(progress)
    return result.data, result.text
