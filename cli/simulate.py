"""``masiv simulate``: the twin in situations that were never filmed."""

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
    vector,
)


def simulate(
    run: RunArgument,
    frames: Annotated[int, typer.Option("--frames", min=2, help="Frames to simulate.", show_default=False)],
    velocity: Annotated[
        str | None, typer.Option("--velocity", metavar="VX,VY,VZ", help="Initial velocity [m/s].")
    ] = None,
    omega: Annotated[str | None, typer.Option("--omega", metavar="WX,WY,WZ", help="Initial spin [rad/s].")] = None,
    gravity: Annotated[str | None, typer.Option("--gravity", metavar="GX,GY,GZ", help="Gravity [m/s²].")] = None,
    law: Annotated[Path | None, typer.Option("--law", metavar="OTHER_RUN", help="The material of another run.")] = None,
    blend: Annotated[
        float | None, typer.Option("--blend", metavar="W", help="With --law: 0 is this run's material, 1 the other's.")
    ] = None,
    geometry: Annotated[
        Path | None,
        typer.Option("--geometry", metavar="MESH|OTHER_RUN", help="Another body: a closed mesh, or another run's."),
    ] = None,
    density: Annotated[float | None, typer.Option("--density", help="Density [kg/m³].")] = None,
    ground: Annotated[
        str | None, typer.Option("--ground", metavar="none|HEIGHT", help="No ground, or one at this height [m].")
    ] = None,
    force: Annotated[
        str | None,
        typer.Option("--force", metavar="FX,FY,FZ", help="Force on the whole body [N], spread over its mass."),
    ] = None,
    force_from: Annotated[float | None, typer.Option("--force-from", help="When it starts [s]. [default: 0]")] = None,
    force_until: Annotated[
        float | None, typer.Option("--force-until", help="When it ends [s]. [default: never]")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", metavar="EFFECT", help="Leave out an effect of the twin; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Where to write; no run folder. [default: RUN_simulate, here]")
    ] = None,
    condition: Annotated[
        str | None, typer.Option("--condition", help="Tracks: with what acts in the runs of this condition.")
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Also draw views/*.png and video.mp4; so do the next three options.")
    ] = False,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            metavar="CAMERA|free:X,Y,Z,LX,LY,LZ|orbit",
            help="Index or name of a camera of the scene; a place and what it looks at [m]; or around the body "
            "(orbit:turns=1,elevation=20,distance=3). May be repeated. [default: 0]",
        ),
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Size of the pictures [px]. [default: the camera's]")
    ] = None,
    slow: Annotated[
        float | None, typer.Option("--slow", metavar="FACTOR", help="Slow the video down. [default: 1]")
    ] = None,
    scene: MovedSceneOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Simulate the twin from another initial state or in other conditions: rollout.npz, and pictures with --render.

    What is not given is as identified.

    Example: `masiv simulate runs/bunny --frames 32 --velocity=1,2,0 --gravity=0,-1.6,0 --out moon --render`

    Once round it, four times slower: `masiv simulate runs/bunny --frames 32 --camera orbit --slow 4 --size 640x480`

    Another: `masiv simulate runs/bunny --frames 32 --law runs/cross --blend 0.5 --force=0,0,900 --force-until 0.1`
    """
    from masiv.pipeline import SimulateRequest, reopen_run

    from .console import progress_bar

    request = SimulateRequest(
        frames,
        velocity=vector(velocity, "--velocity"),
        omega=vector(omega, "--omega"),
        gravity=vector(gravity, "--gravity"),
        law=law,
        blend=blend,
        geometry=geometry,
        density=density,
        ground=ground,
        force=vector(force, "--force"),
        force_from=force_from,
        force_until=force_until,
        without=tuple(without or ()),
        condition=condition,
        render=render,
        camera=tuple(camera or ()),
        size=size,
        slow=slow,
    )
    opened = reopen_run(run, overrides(preset, config, seed, arch, assignments), scene=scene)
    with progress_bar() as progress:
        result = opened.simulate(request, out or Path(f"{run.resolve().name}_simulate"), progress)
    return result.data, result.text
