"""``masiv refine``: close the loop. What does the model lack?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, RunArgument, SeedOption


def refine(
    run: RunArgument,
    second: Annotated[
        Path | None,
        typer.Option("--second-run", help="Another throw of the same object: fitted jointly, and held out as well."),
    ] = None,
    group: Annotated[
        bool, typer.Option("--group", help="Tracks: bodies in flight that share physics, refined together.")
    ] = False,
    condition: Annotated[
        str | None, typer.Option("--condition", help="Tracks: what do the runs of this condition lack besides?")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rank the effects, fit none; changes no twin.")] = False,
    relearn: Annotated[
        bool,
        typer.Option("--relearn", help="Learn the neural law anew beside the effects. [default: the classical law]"),
    ] = False,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Find the physical effect that the model lacks, add it, and report the error before and after.

    What is accepted goes into twin.yaml (the old one is kept as twin.before.yaml), so that simulate uses it.

    Example: `masiv refine runs/torus --second-run runs/torus_seq1`

    Tracks: `masiv refine runs/balls --group`, `masiv refine runs/beam --condition load`
    """
    from masiv.errors import InputError

    from . import stages, tracked
    from .console import progress_bar

    if tracked.is_run(run):
        tracked.refused(second_run=second)
        opened = tracked.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
        return tracked.refine(*opened, group=group, condition=condition, dry_run=dry_run)
    if group or condition is not None:
        raise InputError(f"{run} is of a scene of pictures: --group and --condition are for tracks")
    folder, settings, scene = stages.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
    folder.require("identify")
    runs = [(run, folder, scene)]
    if second is not None:
        other, _, other_scene = stages.reopen_run(second, preset=None, config=None, seed=None, arch=arch)
        other.require("trajectory")
        runs.append((second, other, other_scene))
    stages.start(settings)
    from masiv.refine.stage import refine as search
    from masiv.refine.summary import text

    from .refining import load_twin, save, throw_of

    with progress_bar() as progress:
        throws = [throw_of(path, f, settings, s, progress) for path, f, s in runs]
        twin = load_twin(run)
        found = search(
            throws,
            settings.identify,
            settings.simulator,
            settings.refine,
            start=twin.fit.get("start") or twin.fit.get("law"),
            dry_run=dry_run,
            checkpoint=folder.checkpoint("refine"),
            progress=progress,
        )
        document = save(
            folder, scene, throws[0], found, twin, settings.refine, dry_run, progress,
            relearn_with=settings if relearn else None,
        )  # fmt: skip
    folder.checkpoint("refine").clear()
    return {"refine": str(run / "refine.json"), **document}, text(document)
