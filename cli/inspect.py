"""``masiv inspect``: what was read of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SceneArgument, SeedOption


def inspect(
    scene: SceneArgument,
    out: Annotated[
        Path | None, typer.Option("--out", help="Where to write the picture. [default: SCENE_inspect.png]")
    ] = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Say what was read: cameras, frames, units, up axis, masks, problems; and draw it.

    Example: `masiv inspect scenes/bunny --out bunny.png`
    """
    from masiv.config import load_config
    from masiv.report.contact_sheet import write_contact_sheet
    from masiv.scene.read import read_scene
    from masiv.scene.summary import as_text, summarise

    load_config(preset, config, seed=seed, arch=arch)
    read = read_scene(scene)
    summary = summarise(read)
    target = out or Path(f"{scene.resolve().stem if scene.is_file() else scene.resolve().name}_inspect.png")
    write_contact_sheet(read, target)
    summary["picture"] = str(target)
    return summary, as_text(summary)
