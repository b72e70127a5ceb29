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
    """Say what was read: cameras or markers, frames, units, up axis, masks, problems; and draw it.

    Example: `masiv inspect scenes/bunny --out bunny.png`
    """
    from masiv.config import load_config
    from masiv.observations.read import read_observation
    from masiv.report.contact_sheet import write_contact_sheet
    from masiv.scene.summary import as_text, summarise
    from masiv.tracks.summary import summarise_tracks, tracks_as_text, write_tracks_picture
    from masiv.tracks.tracks import Tracks

    load_config(preset, config, seed=seed, arch=arch)
    read = read_observation(scene)
    target = out or Path(f"{scene.resolve().stem if scene.is_file() else scene.resolve().name}_inspect.png")
    if isinstance(read, Tracks):
        write_tracks_picture(read, target)
        summary = {**summarise_tracks(read), "picture": str(target)}
        return summary, tracks_as_text(summary)
    write_contact_sheet(read, target)
    summary = {**summarise(read), "picture": str(target)}
    return summary, as_text(summary)
