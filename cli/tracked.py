"""Commands on scenes of tracks: measured points instead of pictures. There is nothing to reconstruct."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv import runtime
from masiv.config import Config, load_config
from masiv.errors import InputError
from masiv.files import write_json
from masiv.runfolder import Request, RunFolder
from masiv.strict import read_yaml
from masiv.tracks.read import read_tracks, recognises
from masiv.tracks.summary import identity
from masiv.tracks.tracks import Tracks

if TYPE_CHECKING:
    import numpy as np

    from masiv.progress import Progress
    from masiv.tracks.twin import TracksTwin

BEFORE = "twin.before.yaml"


def is_scene(scene: Path) -> bool:
    """Whether ``scene`` is a scene of tracks."""
    return scene.is_dir() and recognises(scene)


def is_run(run: Path) -> bool:
    """Whether ``run`` is of a scene of tracks. Raises InputError where it is no run folder."""
    return RunFolder.open(run).record["scene"].get("layout") == "tracks"


def refused(**given: Any) -> None:
    """Raises InputError for an option that means nothing without pictures."""
    for name, value in given.items():
        if value not in (None, False, []):
            raise InputError(f"--{name.replace('_', '-')} is for scenes of pictures: leave it out for one of tracks")


def open_run(
    scene: Path,
    out: Path,
    *,
    preset: str | None,
    config: Path | None,
    seed: int | None,
    arch: str | None,
    law: str | None = None,
) -> tuple[RunFolder, Config, Tracks]:
    """As ``stages.open_run``. Where no law is named it is auto, since markers cannot teach a neural one."""
    existing = RunFolder.open(out) if (out / "run.yaml").is_file() else None
    named = config is not None and "law" in (read_yaml(config).get("identify") or {})
    if law is None and existing is None and not named:
        law = "auto"
    flags: dict[str, int | str | None] = {"seed": seed, "arch": arch, "identify.law": law}
    settings = load_config(preset, config, existing.config if existing else None, **flags)
    if settings.identify.law in ("neural", "adapter"):
        raise InputError(
            f"--law {settings.identify.law} needs the motion of a whole body, and markers show a few points of it: "
            "use --law auto or a classical law"
        )
    tracks = read_tracks(scene)
    request = Request(settings.model_dump(mode="json"), scene, identity(tracks), 0)
    return RunFolder.create_or_resume(out, request), settings, tracks


def reopen_run(
    run: Path, *, preset: str | None, config: Path | None, seed: int | None, arch: str | None
) -> tuple[RunFolder, Config, Tracks]:
    """An existing run whose identify stage is done."""
    existing = RunFolder.open(run)
    opened = open_run(existing.scene_path, run, preset=preset, config=config, seed=seed, arch=arch)
    opened[0].require("identify")
    return opened


def identify(run: RunFolder, config: Config, tracks: Tracks) -> tuple[dict[str, Any], str]:
    """Law and starts; twin.yaml, metrics.json and report.html."""
    from .console import progress_bar

    runtime.start(config.arch)
    from masiv.refine.tracks_stage import identify_tracks
    from masiv.tracks.twin import TracksTwin

    families = []
    with progress_bar() as progress:
        if run.done("identify"):
            twin = TracksTwin.load(run.path)
        else:
            with run.stage("identify"):
                twin, fits = identify_tracks(tracks, config, folder=_kept(run), progress=progress)
                families = [
                    {"law": f.model.family.kind, "fit_rmse_mm": f.fit_mm, "held_out_rmse_mm": f.held_out_mm}
                    for f in fits
                ]
                twin.save(run.path)
        rows = report(run, config, tracks, twin, progress)
    law = {
        "kind": twin.law,
        "parameters": {n: {"value": v, "unit": u, "stderr": e} for n, (v, u, e) in twin.parameters.items()},
    }
    data = {"run": str(run.path), "report": str(run.report), "law": law, "families": families, "runs": rows}
    lines = [f"law      {twin.law}"]
    for name, (value, unit, error) in twin.parameters.items():
        lines.append(f"         {name.replace('_', ' ')} {value:.4g} {unit}" + _error(error))
    return data, "\n".join([*lines, *table(rows), f"report   {run.report}"])


def _error(error: float | None) -> str:
    return " (given)" if error is None else f" ± {error:.2g}"


def _kept(run: RunFolder) -> Path:
    """Rollouts of a stage that is not finished."""
    return run.path / "checkpoints" / "rollouts"


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Errors of runs for a terminal."""
    out = []
    for row in rows:
        errors = ", ".join(f"{n.removesuffix('_mm')} {row[n]:.4g} mm" for n in ("before_mm", "after_mm") if n in row)
        out.append(f"  {row['run']:28s} {row['use']:9s} {errors}")
    return out


def report(
    run: RunFolder, config: Config, tracks: Tracks, twin: TracksTwin, progress: Progress
) -> list[dict[str, Any]]:
    """Simulate every run with the twin, and with that before refine where there is one; metrics.json, rollout.npz,
    report.html. Returns the errors of each run."""

    from masiv.refine.tracks_document import named, observed_of
    from masiv.refine.tracks_stage import run_errors, simulated
    from masiv.report.tracks_page import write_page
    from masiv.simulation.tracks import save_rollout
    from masiv.tracks.twin import TracksTwin

    twins = {"after": twin} if not (run.path / BEFORE).is_file() else {
        "before": TracksTwin.load(run.path, BEFORE), "after": twin
    }  # fmt: skip
    if len(twins) == 1:
        twins = {"before": twin}
    scopes = [None] if twin.group is not None else list(dict.fromkeys(r.condition for r in tracks.runs))
    rows: dict[str, dict[str, Any]] = {}
    curves: dict[str, dict[str, np.ndarray]] = {}
    arrays: dict[str, np.ndarray] = {}
    for done, scope in enumerate(scopes):
        if scope is not None and not any(r.purpose == "fit" for r in tracks.runs if r.condition == scope):
            continue
        for name, model in twins.items():
            progress("report: simulate", done, len(scopes), name)
            made = simulated(tracks, model, config, scope)
            fields = made.fields()
            for r, f in zip(made.simulation.observations, fields, strict=True):
                observed = observed_of(r)
                own = curves.setdefault(r.name, {"times": r.times, "observed": observed})
                own[name] = observed + f
            for row in run_errors(made.simulation.observations, fields):
                error = row.pop("rmse_mm")
                rows.setdefault(row["run"], row)[f"{name}_mm"] = error
    progress("report: simulate", len(scopes), len(scopes))
    for name, own in curves.items():
        arrays |= {f"{key}@{name}": value for key, value in own.items()}
    save_rollout(run.path, arrays)
    found = list(rows.values())
    write_json(run.metrics, {"runs": found, "unit": "mm", "what": "root mean square distance of the points"})
    refined = [named(json.loads(p.read_text(encoding="utf-8"))) for p in sorted(run.path.glob("refine*.json"))]
    write_page(run.report, tracks, twin, found, curves, refined)
    return found


def refine(
    run: RunFolder, config: Config, tracks: Tracks, *, group: bool, condition: str | None, dry_run: bool
) -> tuple[dict[str, Any], str]:
    """Close the loop: refine.json (refine.CONDITION.json), the new twin, the report."""
    from .console import progress_bar

    runtime.start(config.arch)
    from masiv.identify.tracks import conditions
    from masiv.refine.summary import ADDED, text
    from masiv.refine.tracks_document import document, named, save_fields
    from masiv.refine.tracks_stage import refine_tracks, twin_after
    from masiv.tracks.twin import TracksTwin

    twin = TracksTwin.load(run.path)
    if group and twin.group is None:
        raise InputError(f"{run.path} is of one body: --group is for bodies that fly free and share physics")
    with progress_bar() as progress:
        found = refine_tracks(
            tracks, twin, config, condition=condition, dry_run=dry_run, folder=_kept(run), progress=progress
        )
        written = document(found, config.refine, dry_run=dry_run)
        other = condition is not None and condition != conditions(tracks)[0]
        stem = f"refine.{condition}" if other else "refine"
        write_json(run.path / f"{stem}.json", written)
        save_fields(run.path / f"{stem}.npz", found)
        if written["verdict"] == ADDED:
            if not (run.path / BEFORE).is_file():
                twin.save(run.path, BEFORE)
            twin = twin_after(twin, found)
            twin.save(run.path)
        report(run, config, tracks, twin, progress)
    if _kept(run).exists():
        shutil.rmtree(_kept(run))
    lines = [text(named(written))]
    for body, row in written["bodies"].items():
        held = row["held_out_mm"]
        what = ", ".join(row["effects"]) or row["verdict"]
        lines.append(f"  {body:24s} {what:28s} held out {held['before']:.0f} -> {held['after']:.0f} mm")
    for row in written["shared"]:
        lines.append(
            f"one {row['parameter'].replace('_', ' ')} for {', '.join(row['bodies'])}: {row['value']:.3g} ± "
            f"{row['stderr']:.2g} {row['unit']}, {row['spread_between_bodies']:.2g} between them"
        )
    return {"refine": str(run.path / f"{stem}.json"), **written}, "\n".join(lines)


def simulate(
    run: RunFolder, config: Config, tracks: Tracks, *, frames: int, gravity: np.ndarray | None,
    without: list[str], condition: str | None, out: Path,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """rollout.npz with particles and markers."""
    runtime.start(config.arch)
    from masiv.simulation.tracks import save_rollout, simulate_tracks
    from masiv.tracks.twin import TracksTwin

    twin = TracksTwin.load(run.path)
    arrays = simulate_tracks(
        tracks, twin, config, frames=frames, gravity=gravity, without=tuple(without), condition=condition
    )
    path = save_rollout(out, arrays)
    data: Mapping[str, Any] = {
        "rollout": str(path),
        "frames": frames,
        "particles": arrays["positions"].shape[1],
        "markers": arrays["marker_names"].tolist(),
        "effects": [e.effect for e in twin.effects if e.effect not in without],
    }
    return dict(data), str(path)


def evaluate(run: RunFolder, config: Config, tracks: Tracks) -> tuple[dict[str, Any], str]:
    """Errors of every run, those held out apart, before and after refine; evaluate.json."""
    from .console import progress_bar

    runtime.start(config.arch)
    from masiv.tracks.twin import TracksTwin

    with progress_bar() as progress:
        rows = report(run, config, tracks, TracksTwin.load(run.path), progress)
    numbers = {
        "fit": [r for r in rows if r["use"] == "fit"],
        "held_out": [r for r in rows if r["use"] == "hold_out"],
        "unit": "mm",
    }
    write_json(run.evaluation, numbers)
    return {"evaluation": str(run.evaluation), **numbers}, "\n".join([*table(rows), str(run.evaluation)])
