"""``masiv export``: results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption, SetOption


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder, or what masiv simulate wrote.", show_default=False)
    ],
    format: Annotated[
        str,
        typer.Option(
            "--format",
            help="vtkhdf, ply (particles), obj, glb, usd (surface), 3dgs (Gaussians), csv (law), newton (twin).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="File or folder to write. [default: RUN_FORMAT, here]")
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option("--run", metavar="RUN", help="Of a simulation: the run it was made from (up axis, Gaussians)."),
    ] = None,
    motion: Annotated[
        str, typer.Option("--motion", help="rollout: of the twin. trajectory: as observed, of pictures and clouds.")
    ] = "rollout",
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Write the motion, the law or the twin for ParaView, Blender, viewers of 3DGS, spreadsheets or Newton.

    Example: `masiv export runs/bunny --format vtkhdf --out bunny.vtkhdf`

    Another: `masiv export moon --run runs/bunny --format 3dgs --out moon_gaussians`
    """
    from masiv.config import load_config
    from masiv.pipeline import export_results

    from .console import progress_bar

    settings = load_config(preset, config, assignments=assignments or (), seed=seed, arch=arch)
    with progress_bar() as progress:
        result = export_results(
            folder, format, out, run=run, motion=motion, arch=settings.arch, progress=progress
        )  # fmt: skip
    return result.data, result.text
