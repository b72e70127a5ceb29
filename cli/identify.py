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
    PresetOption,
    SceneArgument,
    SeedOption,
)


def identify(
    scene: SceneArgument,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder. [default: runs/SCENE]")] = None,
    fit_frames: FitFramesOption = None,
    holdout: HoldoutOption = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """From video to twin: runs every stage that the run folder lacks, then writes rollout, numbers and a report.

    Example: `masiv identify scenes/bunny --out runs/bunny --preset quick --fit-frames 12`
    """
    from . import stages
    from .console import progress_bar

    run, settings, read = stages.open_run(
        scene,
        out or Path("runs") / scene.resolve().name,
        preset=preset,
        config=config,
        seed=seed,
        arch=arch,
        fit_frames=fit_frames,
        holdout=holdout,
    )
    stages.start(settings)
    from masiv.mpm.simulate import simulate
    from masiv.report.numbers import run_numbers, table
    from masiv.report.report import write_report
    from masiv.runfolder import write_json

    with progress_bar() as progress:
        dynamic = stages.reconstructed(run, settings, read, progress)
        trajectory = stages.estimated(run, settings, read, progress)
        twin = stages.identified(run, settings, read, progress)
        motion = simulate(twin, frames=read.frame_count, fps=read.fps, progress=progress)
        motion.save(run.rollout)
        numbers = run_numbers(run, read, dynamic, trajectory, motion.positions)
        write_json(run.metrics, numbers)
        progress("report", 0, 1)
        write_report(run, read, dynamic, trajectory, twin, motion.positions, numbers)
        progress("report", 1, 1)
    data = {"run": str(run.path), "report": str(run.report), "metrics": numbers}
    return data, f"{table(numbers)}\nreport   {run.report}"
