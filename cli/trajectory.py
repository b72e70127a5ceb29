"""``masiv trajectory``: the filled continuum and its motion."""

from __future__ import annotations

from typing import Any

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


def trajectory(
    run: RunArgument,
    scene: MovedSceneOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Fill the object and follow its particles: trajectory.npz in the run folder.

    Example: `masiv trajectory runs/bunny`
    """
    from masiv.pipeline import reopen_run

    from .console import progress_bar

    opened = reopen_run(run, overrides(preset, config, seed, arch, assignments), scene=scene)
    with progress_bar() as progress:
        result = opened.trajectory(progress)
    return result.data, result.text
