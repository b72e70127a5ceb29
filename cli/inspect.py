"""``masiv inspect``: what was read of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SceneArgument, SeedOption, SetOption, overrides


def inspect(
    scene: SceneArgument,
    out: Annotated[
        Path | None, typer.Option("--out", help="Where to write the picture. [default: SCENE_inspect.png]")
    ] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Show what was read, what is wrong with it, and what the motion will tell of the body; and draw it.

    Example: `masiv inspect scenes/bunny --out bunny.png`
    """
    from masiv.pipeline import inspect_scene

    result = inspect_scene(scene, out, overrides(preset, config, seed, arch, assignments))
    return result.data, result.text
