"""``masiv evaluate``: against ground truth, observed and future frames apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, RunArgument, SeedOption


def evaluate(
    run: RunArgument,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Folder with particles_F.npy, (P, 3) metres a frame; not for tracks."),
    ] = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Chamfer, tracked error, PSNR and SSIM beside rigid baselines; evaluate.json in the run folder.

    Example: `masiv evaluate runs/bunny --truth scenes/bunny/gt`

    Tracks: errors of the runs, those that were held out apart: `masiv evaluate runs/beam`
    """
    from masiv.errors import InputError

    from . import stages, tracked
    from .console import progress_bar

    if tracked.is_run(run):
        tracked.refused(truth=truth)
        return tracked.evaluate(*tracked.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch))
    if truth is None:
        raise InputError("--truth is missing: give the folder with particles_F.npy")
    folder, settings, scene = stages.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
    folder.require("trajectory")
    stages.start(settings)
    from masiv.files import write_json
    from masiv.report.numbers import evaluation_numbers, table
    from masiv.runfolder import load_motion
    from masiv.twin import Twin

    dynamic, trajectory = stages.load_dynamic(folder), stages.load_trajectory(folder)
    twin, rollout = None, None
    if folder.done("identify") and folder.rollout.is_file():
        twin, (rollout, _) = Twin.load(run), load_motion(folder.rollout)
    with progress_bar() as progress:
        numbers = evaluation_numbers(folder, scene, dynamic, trajectory, twin, rollout, truth, progress=progress)
    write_json(folder.evaluation, numbers)
    return {"evaluation": str(folder.evaluation), **numbers}, f"{table(numbers)}\n{folder.evaluation}"
