"""``masiv simulate``: the twin in situations that were never filmed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, RunArgument, SeedOption, vector


def simulate(
    run: RunArgument,
    frames: Annotated[int, typer.Option("--frames", min=2, help="Frames to simulate.", show_default=False)],
    velocity: Annotated[
        str | None, typer.Option("--velocity", metavar="VX,VY,VZ", help="Initial velocity [m/s].")
    ] = None,
    omega: Annotated[str | None, typer.Option("--omega", metavar="WX,WY,WZ", help="Initial spin [rad/s].")] = None,
    gravity: Annotated[str | None, typer.Option("--gravity", metavar="GX,GY,GZ", help="Gravity [m/s²].")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Where to write. [default: RUN/simulate]")] = None,
    render: Annotated[bool, typer.Option("--render", help="Also draw views/*.png and video.mp4.")] = False,
    view: Annotated[
        list[int] | None, typer.Option("--view", help="Camera to draw; may be repeated. [default: 0]")
    ] = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Throw the twin anew: rollout.npz, and pictures with --render. What is not given is as identified.

    Example: `masiv simulate runs/bunny --frames 32 --velocity=1,2,0 --gravity=0,-1.6,0 --out moon --render`
    """
    from masiv.errors import InputError

    from . import stages
    from .console import progress_bar

    given = {
        "velocity": vector(velocity, "--velocity"),
        "omega": vector(omega, "--omega"),
        "gravity": vector(gravity, "--gravity"),
    }
    folder, settings, scene = stages.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
    folder.require("identify")
    views = view or [0]
    for index in views:
        if not 0 <= index < len(scene.cameras):
            raise InputError(f"--view {index}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    target = out or run / "simulate"
    stages.start(settings)
    from masiv.mpm.simulate import simulate as roll
    from masiv.report.film import film
    from masiv.twin import Twin

    with progress_bar() as progress:
        motion = roll(Twin.load(run), frames=frames, fps=scene.fps, progress=progress, **given)
        target.mkdir(parents=True, exist_ok=True)
        motion.save(target / "rollout.npz")
        if render:
            film(scene, stages.load_dynamic(folder), motion.positions, views, target, progress=progress)
    data = {"rollout": str(target / "rollout.npz"), "frames": frames, "particles": motion.positions.shape[1]}
    if render:
        data["video"] = str(target / "video.mp4")
    return data, "\n".join(str(data[name]) for name in ("rollout", "video") if name in data)
