"""``masiv simulate``: the twin in situations that were never filmed."""

from __future__ import annotations

from dataclasses import replace
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
    out: Annotated[Path | None, typer.Option("--out", help="Where to write. [default: RUN/simulate]")] = None,
    condition: Annotated[
        str | None, typer.Option("--condition", help="Tracks: with what acts in the runs of this condition.")
    ] = None,
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

    Another: `masiv simulate runs/bunny --frames 32 --law runs/cross --blend 0.5 --force=0,0,900 --force-until 0.1`
    """
    from masiv.errors import InputError

    from . import stages, tracked
    from .console import progress_bar

    thrown = vector(velocity, "--velocity"), vector(omega, "--omega"), vector(gravity, "--gravity")
    if tracked.is_run(run):
        tracked.refused(
            velocity=velocity, omega=omega, law=law, blend=blend, geometry=geometry, density=density, ground=ground,
            force=force, force_from=force_from, force_until=force_until, render=render, view=view,
        )  # fmt: skip
        opened = tracked.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
        return tracked.simulate(
            *opened,
            frames=frames,
            gravity=thrown[2],
            without=without or [],
            condition=condition,
            out=out or run / "simulate",
        )
    if condition is not None:
        raise InputError(f"{run} is of a scene of pictures: --condition is for tracks")
    folder, settings, scene = stages.reopen_run(run, preset=preset, config=config, seed=seed, arch=arch)
    folder.require("identify")
    views = view or [0]
    for index in views:
        if not 0 <= index < len(scene.cameras):
            raise InputError(f"--view {index}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    target = out or run / "simulate"
    pushed = force_from is not None or force_until is not None
    if force is None and pushed:
        raise InputError("--force-from and --force-until need --force FX,FY,FZ")
    if blend is not None and law is None:
        raise InputError("--blend W needs --law OTHER_RUN, the run whose material is blended in")
    strength = vector(force, "--force")
    stages.start(settings)
    from masiv.report.film import film
    from masiv.simulation.simulate import Push
    from masiv.simulation.simulate import simulate as roll
    from masiv.simulation.twin_effects import body_mass
    from masiv.simulation.variation import without_effects

    push = None
    if strength is not None:
        until = float("inf") if force_until is None else force_until
        push = Push(strength, 0.0 if force_from is None else force_from, until)
    twin, look = stages.varied(folder, law=law, blend=blend, geometry=geometry, density=density, ground=ground)
    twin = without_effects(twin, tuple(without or ()))
    with progress_bar() as progress:
        motion = roll(
            twin, frames=frames, fps=scene.fps, velocity=thrown[0], omega=thrown[1], gravity=thrown[2], push=push,
            progress=progress,
        )  # fmt: skip
        target.mkdir(parents=True, exist_ok=True)
        motion.save(target / "rollout.npz")
        if render:
            seen = replace(scene, ground=scene.ground if ground is None else twin.ground)
            film(seen, look(), motion.positions, views, target, progress=progress)
    data = {
        "rollout": str(target / "rollout.npz"),
        "frames": frames,
        "particles": motion.positions.shape[1],
        "mass_kg": body_mass(twin),
        "law": twin.law.description(),
        "effects": [effect.name for effect in twin.effects],
    }
    if render:
        data["video"] = str(target / "video.mp4")
    return data, "\n".join(str(data[name]) for name in ("rollout", "video") if name in data)
