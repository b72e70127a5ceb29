"""What ``masiv refine`` reads from a run folder and leaves in it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from masiv.config import Config
from masiv.files import write_json, write_npz, write_yaml
from masiv.progress import Progress
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene

from . import stages

if TYPE_CHECKING:
    from masiv.refine.config import RefineConfig
    from masiv.refine.stage import Refined, Throw
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin

BEFORE = "twin.before.yaml"
LAW_BEFORE = "law.before.safetensors"


def throw_of(path: Path, run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Throw:
    """The motion of a run: what was fitted, and held-out frames measured in a pass of their own."""
    from masiv.refine.stage import Throw, split_frames

    trajectory = stages.load_trajectory(run)
    held_out = stages.held_out_trajectory(run, config, scene, progress)
    fitted = split_frames(scene.frame_count, run.fit_frames)
    return Throw(path.resolve().name, scene, trajectory, held_out or trajectory, fitted)


def load_twin(run: Path) -> Twin:
    """The twin that identify made: refining again starts from that."""
    from masiv.twin import Twin

    return Twin.load(run, BEFORE if (run / BEFORE).is_file() else "twin.yaml")


def save(
    run: RunFolder,
    scene: Scene,
    throw: Throw,
    found: Refined,
    twin: Twin,
    config: RefineConfig,
    dry_run: bool,
    progress: Progress,
    relearn_with: Config | None = None,
) -> dict[str, Any]:
    """Write refine.json, refine.npz and the report, and where an effect was accepted the new twin and what it gives.

    relearn_with: settings with which its law is learnt anew beside the effects; the classical one stays where None."""
    from masiv.refine.stage import twin_of
    from masiv.refine.summary import summary
    from masiv.simulation.simulate import simulate

    document = summary(found, config, dry_run=dry_run)
    changed = bool(document["accepted"] or document["stop_gap"]) and not dry_run
    new = twin_of(found.result.gap or found.result.after, throw, found.simulation, twin)
    if relearn_with is not None and changed:
        new = _relearnt(run, relearn_with, new, scene, progress)
    old = twin_of(found.result.before, throw, found.simulation, twin)
    dynamic = stages.load_dynamic(run)
    rollouts = {
        name: simulate(model, frames=scene.frame_count, fps=scene.fps, progress=progress).positions
        for name, model in (("before", old), ("after", new))
    }
    for name, positions in rollouts.items():
        for split, numbers in _pictures(scene, dynamic, positions, throw, progress).items():
            document[name][split] |= numbers
    _save_fields(run.path / "refine.npz", found)
    if changed:
        _keep_old(run.path)
        _forget(run)
        new.save(run.path)
        _save_rollout(run, rollouts["after"], scene)
    elif (run.path / BEFORE).is_file() and not dry_run:
        _forget(run)
        twin.save(run.path)  # an earlier refine had accepted something that this one does not
        (run.path / BEFORE).unlink()
    write_json(run.path / "refine.json", document)
    _report(run, scene, dynamic, progress)
    return document


def _relearnt(run: RunFolder, config: Config, twin: Twin, scene: Scene, progress: Progress) -> Twin:
    from masiv.identify.stage import relearn

    seen = stages.fitted_scene(run, scene)
    trajectory = stages.load_trajectory(run)
    checkpoint = run.checkpoint("relearn")
    learnt = relearn(
        twin, seen, trajectory, config.identify, seed=config.seed, checkpoint=checkpoint, progress=progress
    )
    checkpoint.clear()
    return learnt


def _forget(run: RunFolder) -> None:
    """Delete what is told of a twin that is about to change: a run that is killed then tells nothing old."""
    from masiv.report.material import MATERIAL

    for path in (run.rollout, run.metrics, run.path / MATERIAL):
        path.unlink(missing_ok=True)


def _report(run: RunFolder, scene: Scene, dynamic: DynamicGaussians, progress: Progress) -> None:
    """Write report.html, and before it what the run lacks of rollout, material.json and metrics.json."""
    from masiv.report.material import MATERIAL
    from masiv.report.numbers import material_numbers, run_numbers
    from masiv.report.report import write_report
    from masiv.runfolder import load_motion
    from masiv.simulation.simulate import simulate
    from masiv.twin import Twin

    progress("report", 0, 1)
    twin, trajectory = Twin.load(run.path), stages.load_trajectory(run)
    if not run.rollout.is_file():
        simulate(twin, frames=scene.frame_count, fps=scene.fps, progress=progress).save(run.rollout)
    rollout, _ = load_motion(run.rollout)
    if not (run.path / MATERIAL).is_file():
        stages.describe(run, twin, progress)
    if not run.metrics.is_file():
        numbers = run_numbers(run, scene, dynamic, trajectory, rollout)
        write_json(run.metrics, numbers | material_numbers(run))
    numbers = json.loads(run.metrics.read_text(encoding="utf-8"))
    write_report(run, scene, dynamic, trajectory, twin, rollout, numbers)
    progress("report", 1, 1)


def _pictures(scene: Scene, dynamic, positions: np.ndarray, throw: Throw, progress: Progress) -> dict[str, dict]:
    """Chamfer to the observed motion, and pictures against the video, over fitted and held-out frames."""
    from masiv import metrics
    from masiv.report import measure
    from masiv.report.follow import Binding

    binding = Binding.at_rest(dynamic.at(0.0), positions[0])
    views = list(range(len(scene.cameras)))
    out = {}
    for split, frames in (
        ("fit", list(range(1, throw.fitted))),
        ("held_out", list(range(throw.fitted, scene.frame_count))),
    ):
        if not frames:
            continue
        numbers = measure.picture_numbers(scene, lambda f: binding.moved(positions[f]), views, frames) or {}
        kept = {k: numbers[k] for k in ("psnr_db", "psnr_box_in_scene_db", "ssim", "mask_iou") if k in numbers}
        chamfer = [metrics.chamfer_1e3mm2(positions[f], throw.whole.positions[f]) for f in frames]
        out[split] = {"frames": frames, "chamfer_1e3mm2": float(np.mean(chamfer)), **kept}
        progress("refine: pictures", 1 if split == "fit" else 2, 2)
    return out


def _save_fields(path: Path, found: Refined) -> None:
    """Residuals of the first throw (K, N, 3) [m, world], simulated less observed, where they are and when."""
    problem = found.simulation.observations[0].problem
    turn = problem.axes.vectors_to_world
    write_npz(
        path,
        before=turn(found.before[0]).astype(np.float32),
        after=turn(found.after[0]).astype(np.float32),
        positions=problem.axes.points_to_world(problem.start.double().numpy()).astype(np.float32),
        times=np.arange(1, len(found.before[0]) + 1) / (problem.samples * problem.scene.fps),
        fitted=found.simulation.observations[0].fit_count,
    )


def _save_rollout(run: RunFolder, positions: np.ndarray, scene: Scene) -> None:
    from masiv.simulation.simulate import Rollout

    Rollout(positions, scene.times).save(run.rollout)


def _keep_old(run: Path) -> None:
    """twin.yaml as identify made it, beside the new one. A second refine keeps the first."""
    if (run / BEFORE).is_file():
        return
    shutil.copyfile(run / "law.safetensors", run / LAW_BEFORE)
    document = yaml.safe_load((run / "twin.yaml").read_text(encoding="utf-8"))
    document["law"]["file"] = LAW_BEFORE
    write_yaml(run / BEFORE, document)
