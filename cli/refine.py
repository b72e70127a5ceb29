"""``masiv refine``: close the loop. What does the model lack?"""

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


def refine(
    run: RunArgument,
    second: Annotated[
        Path | None,
        typer.Option(
            "--second-run", help="Another recording of the same object: fitted jointly, and split in the same way."
        ),
    ] = None,
    group: Annotated[
        bool, typer.Option("--group", help="Tracks: bodies in flight that share physics, refined together.")
    ] = False,
    condition: Annotated[
        str | None, typer.Option("--condition", help="Tracks: refine the runs of this condition.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rank the effects, fit none; changes no twin.")] = False,
    relearn: Annotated[
        bool,
        typer.Option("--relearn", help="Learn the neural law again with the effects. [default: the classical law]"),
    ] = False,
    scene: MovedSceneOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
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
    from masiv.pipeline import RefineRequest, reopen_run

    from .console import progress_bar

    request = RefineRequest(second, group, condition, dry_run, relearn)
    opened = reopen_run(run, overrides(preset, config, seed, arch, assignments), scene=scene)
    with progress_bar() as progress:
        result = opened.refine(request, progress)
    return result.data, result.text
