"""``masiv trajectory``: the filled continuum and its motion."""

from __future__ import annotations

from typing import Any

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, RunArgument, SeedOption


def trajectory(
    run: RunArgument,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Fill the object and follow its particles: trajectory.npz in the run folder.

    Example: `masiv trajectory runs/bunny`
    """
    from . import stages
    from .console import progress_bar

    folder, settings, scene = stages.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
    with progress_bar() as progress:
        made = stages.estimated(folder, settings, scene, progress)
    frames, particles = made.positions.shape[:2]
    data = {
        "run": str(run),
        "trajectory": str(folder.trajectory),
        "frames": frames,
        "particles": particles,
        "spacing_m": made.spacing,
        "volume_m3": made.volume,
        "seconds": folder.seconds(),
    }
    text = f"{folder.trajectory}: {particles} particles, {frames} frames, {made.spacing * 1e3:.1f} mm apart"
    return data, f"{text}, {made.volume * 1e3:.2f} litres"
