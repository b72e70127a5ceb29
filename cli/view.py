"""``masiv view``: look into a run in the browser, and simulate its twin again while one looks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .console import announce
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


def view(
    run: RunArgument,
    law: Annotated[
        Path | None, typer.Option("--law", metavar="OTHER_RUN", help="A run whose law can be taken, or blended in.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option("--frames", help="Frames to simulate. [default: as many as were observed]")
    ] = None,
    condition: Annotated[
        str | None, typer.Option("--condition", help="Tracks: the first run of this condition.")
    ] = None,
    host: Annotated[
        str, typer.Option("--host", help="Address to serve at; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port; if it is in use, the next one that is free.")
    ] = 8080,
    scene: MovedSceneOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Show a run in the browser: Gaussians, particles, paths, stress, strain, effects, cameras, and sliders that
    simulate the twin again. Prints the address; Ctrl-C ends it. Needs `pip install 'masiv[view]'`.

    Example: `masiv view runs/bunny --law runs/cross --port 8090`
    """
    from masiv.pipeline import ViewRequest, reopen_run

    request = ViewRequest(frames=frames, law=law, condition=condition, host=host, port=port)
    opened = reopen_run(run, overrides(preset, config, seed, arch, assignments), scene=scene)
    opened.view(request, lambda ready: announce(ready.data, ready.text, as_json))
    return {}, ""
