"""``masiv batch``: many scenes, laws, seeds and settings, on this machine or a cluster."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption, SetOption, overrides


def batch(
    spec: Annotated[Path, typer.Argument(metavar="SPEC", help="YAML file: docs/batch.md.", show_default=False)],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the batch. [default: name of SPEC]")] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, max=1024, help="Stages at a time. [default: one for each core]")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option("--threads", min=1, max=1024, help="Threads of each stage. [default: cores over workers]"),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler", help="Address of a Dask scheduler, as tcp://host:8786, whose workers run the stages."
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the commands, run none.")] = False,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Run scenes × laws × seeds × settings: a folder of runs, one table and one page.

    A stage that fails does not stop the others. The same command again runs what is missing.

    Example: `masiv batch study.yaml --workers 2`
    """
    from masiv.batch.batch import run_batch
    from masiv.batch.run import DONE
    from masiv.errors import MasivError

    from .console import progress_bar

    with progress_bar() as progress:
        result = run_batch(
            spec, out, workers=workers, threads=threads, scheduler=scheduler,
            overrides=overrides(preset, config, seed, arch, assignments), dry_run=dry_run, progress=progress,
        )  # fmt: skip
    failed = [row for row in result.data.get("runs", []) if row["state"] != DONE]
    if failed:
        print(result.text, file=sys.stderr)
        first = next((row for row in failed if row["message"]), failed[0])
        raise MasivError(
            f"{len(failed)} of {len(result.data['runs'])} runs are not done, {first['run']}: {first['message']}; the "
            "same command tries them again"
        )
    return result.data, result.text
