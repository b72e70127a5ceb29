"""``masiv identify``: the main job, from video to twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    ArchOption,
    ConfigOption,
    FitFramesOption,
    HoldoutOption,
    JsonOption,
    PresetOption,
    SceneArgument,
    SeedOption,
)


def identify(
    scene: SceneArgument,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder. [default: runs/SCENE]")] = None,
    law: Annotated[
        str | None,
        typer.Option(
            "--law",
            help="What is fitted: neural, adapter (a correction of a classical law), neo_hookean, newtonian, "
            "non_newtonian, von_mises, drucker_prager, or auto (the classical law that explains the motion best). "
            "[default: neural]",
        ),
    ] = None,
    also: Annotated[
        list[Path] | None,
        typer.Option(
            "--also",
            help="Run folder of another throw of the same object (masiv trajectory has made it), from which a neural "
            "law is learnt, too. May be given several times.",
        ),
    ] = None,
    geometry_loss: Annotated[
        str | None,
        typer.Option(
            "--geometry-loss",
            help="What a neural law is fitted to: trajectory (paths of particles, then surfaces; paths alone with "
            "identify.surface_finetune: false), continuum (bodies frame by frame), surface, or none (pictures alone). "
            "[default: trajectory]",
        ),
    ] = None,
    no_silhouette: Annotated[
        bool, typer.Option("--no-silhouette", help="Fit a neural law to geometry alone, without the pictures.")
    ] = False,
    fit_frames: FitFramesOption = None,
    holdout: HoldoutOption = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """From video to twin: runs every stage that the run folder lacks, then writes rollout, numbers and a report.

    Example: `masiv identify scenes/bunny --out runs/bunny --preset quick --fit-frames 12`

    A scene of tracks (measured points, no pictures) starts with the law: `masiv identify scenes/beam`

    One law from several throws: `masiv identify scenes/egg_1 --out runs/egg_1 --also runs/egg_2 --also runs/egg_3`

    A classical baseline: `masiv identify scenes/bunny --out runs/bunny-elastic --law neo_hookean`
    """
    from . import stages, tracked
    from .console import progress_bar

    if tracked.is_scene(scene):
        tracked.refused(
            fit_frames=fit_frames,
            holdout_camera=holdout,
            geometry_loss=geometry_loss,
            no_silhouette=no_silhouette,
            also=also,
        )
        folder = out or Path("runs") / scene.resolve().name
        opened = tracked.open_run(scene, folder, preset=preset, config=config, seed=seed, arch=arch, law=law)
        return tracked.identify(*opened)
    run, settings, read = stages.open_run(
        scene,
        out or Path("runs") / scene.resolve().name,
        preset=preset,
        config=config,
        seed=seed,
        arch=arch,
        fit_frames=fit_frames,
        holdout=holdout,
        law=law,
        also=[str(path.resolve()) for path in also] if also else None,
        geometry_loss=geometry_loss,
        pictures=0 if no_silhouette else None,
    )
    stages.start(settings)
    from masiv.report.numbers import material_numbers, run_numbers, table
    from masiv.report.report import write_report
    from masiv.runfolder import write_json
    from masiv.simulation.simulate import simulate

    with progress_bar() as progress:
        dynamic = stages.reconstructed(run, settings, read, progress)
        trajectory = stages.estimated(run, settings, read, progress)
        twin = stages.identified(run, settings, read, progress)
        with stages.described(run, settings, twin):
            motion = simulate(twin, frames=read.frame_count, fps=read.fps, progress=progress)
            motion.save(run.rollout)
            numbers = run_numbers(run, read, dynamic, trajectory, motion.positions)
        numbers |= material_numbers(run)
        write_json(run.metrics, numbers)
        progress("report", 0, 1)
        write_report(run, read, dynamic, trajectory, twin, motion.positions, numbers)
        progress("report", 1, 1)
    described = twin.law.description()
    data = {"run": str(run.path), "report": str(run.report), "law": described, "metrics": numbers}
    families = twin.fit.get("families", [])
    if families:
        data["families"] = families
    return data, f"{table(numbers)}\n{_law_text(described, families)}report   {run.report}"


def _law_text(described: dict[str, Any], families: list[dict[str, Any]]) -> str:
    """The parameters of a law with their standard errors, and how well each family did where several were fitted."""
    lines = [f"law      {described['kind']}"]
    for name, entry in described["parameters"].items():
        line = f"         {name.replace('_', ' ')} {entry['value']:.4g} {entry['unit']}"
        if "stderr" in entry:
            known = entry["stderr"] is not None
            line += f" ± {entry['stderr']:.2g}" if known else " (the motion does not tell it)"
        lines.append(line)
    for row in families:
        if "failed" in row:
            lines.append(f"         {row['law']}: failed, {row['failed']}")
        else:
            loss = row["image_loss"]
            nearness = f"BIC {row['bic_above_best']:.0f} above the best" if loss is None else f"image loss {loss:.3f}"
            lines.append(f"         {row['law']}: {row['trajectory_error_mm']:.1f} mm from the paths, {nearness}")
    return "\n".join(lines) + "\n"
