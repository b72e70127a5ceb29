"""Refine runs of pictures, and what that writes into the first run's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.files import write_json
from masiv.pipeline import stages
from masiv.pipeline.expected_memory import expected_memory
from masiv.pipeline.requests import RefineRequest, Summary
from masiv.progress import Progress
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.observations.motion import Observed
    from masiv.observations.video import VideoObservation
    from masiv.pipeline.video import VideoRun
    from masiv.refinement.from_video import Recording
    from masiv.refinement.result import RefineResult
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin


def refine_runs(runs: Sequence[VideoRun], request: RefineRequest, progress: Progress) -> Summary:
    """Refine the first of ``runs`` jointly with the others; writes refine.json, refine.npz, the report and, if an
    effect is accepted, the new twin and what it gives."""
    from masiv.refinement.document_text import text
    from masiv.refinement.from_video import refine_recordings
    from masiv.twin.identified import load_identified

    first = runs[0]
    recordings = [recording_of(run, progress, split_cameras=not request.dry_run) for run in runs]
    particles = max(r.motion.positions.shape[1] for r in recordings)
    memory = expected_memory("refine", recordings[0].scene, first.config, particles)
    memory.announce(first.config.memory_limit_mb, progress)
    twin = load_identified(first.path)
    checkpoint = first.folder.checkpoint("refine")
    result = refine_recordings(
        recordings,
        first.config.identify,
        first.config.simulator,
        first.config.refine,
        start=twin.fit.get("start") or twin.fit.get("law"),
        dry_run=request.dry_run,
        checkpoint=checkpoint,
        progress=progress,
    )
    document = _save(first, recordings[0], result, twin, request, progress)
    checkpoint.clear()
    return Summary({"refine": str(first.path / "refine.json"), **document}, text(document))


def recording_of(run: VideoRun, progress: Progress, *, split_cameras: bool) -> Recording:
    """The motion of a run: fitted frames, and held-out frames measured in a pass of their own; with ``split_cameras``
    the same from two sets of cameras, if the configuration asks for it."""
    from masiv.refinement.from_video import Recording, split_frames

    trajectory = stages.load_trajectory(run.folder)
    split = stages.ensure_camera_split(run.folder, run.config, run.given_scene, progress) if split_cameras else None
    held_out = stages.ensure_held_out_trajectory(run.folder, run.config, run.scene, progress)
    fitted = split_frames(run.scene.frame_count, run.folder.fit_frames)
    return Recording(run.path.resolve().name, run.scene, trajectory, held_out or trajectory, fitted, split)


def _save(
    run: VideoRun, recording: Recording, result: RefineResult, twin: Twin, request: RefineRequest, progress: Progress
) -> dict[str, Any]:
    from masiv.observations.video import VideoObservation
    from masiv.refinement.document import document as document_of
    from masiv.refinement.residual_arrays import save_arrays
    from masiv.refinement.to_twin import baseline_twin, refined_twin
    from masiv.simulation.rollout import Rollout
    from masiv.simulation.simulate import simulate
    from masiv.twin.identified import IDENTIFIED_FILE, restore_identified, save_refined

    folder, scene = run.folder, run.scene
    document = {
        **document_of(result),
        "problems": stages.motion_problems(folder, scene, recording.whole.positions),
    }
    old = baseline_twin(twin, result)
    new = refined_twin(twin, result) if result.changes_twin else old
    if request.relearn and result.changes_twin:
        new = _relearn(run, new, progress)
    dynamic = stages.load_gaussians(folder)
    rollouts = {
        name: simulate(model, frames=scene.frame_count, fps=scene.fps, progress=progress).positions
        for name, model in (("before", old), ("after", new))
    }
    observation = result.observations[0]
    assert isinstance(observation, VideoObservation)
    errors = _picture_errors(scene, dynamic, rollouts, recording.whole, observation, progress)
    for name, by_split in errors.items():
        for split, numbers in by_split.items():
            document[name][split] |= numbers
    if request.dry_run:
        write_json(folder.path / "refine.dry_run.json", document)
        return document
    save_arrays(folder.path / "refine.npz", result)
    if result.changes_twin:
        _delete_artefacts_of_twin(folder)
        save_refined(folder.path, new)
        Rollout(rollouts["after"], scene.times).save(folder.rollout)
    elif (folder.path / IDENTIFIED_FILE).is_file():  # an earlier refine had accepted something that this one does not
        _delete_artefacts_of_twin(folder)
        restore_identified(folder.path)
    write_json(folder.path / "refine.json", document)
    _report(folder, scene, dynamic, progress)
    return document


def _relearn(run: VideoRun, twin: Twin, progress: Progress) -> Twin:
    from masiv.identification.stage import relearn

    checkpoint = run.folder.checkpoint("relearn")
    learnt = relearn(
        twin,
        stages.training_scene(run.folder, run.scene),
        stages.load_trajectory(run.folder),
        run.config.identify,
        seed=run.config.seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    checkpoint.clear()
    return learnt


def _delete_artefacts_of_twin(run: RunFolder) -> None:
    """Delete what describes a twin that is about to change, so that a killed run holds nothing outdated."""
    from masiv.report.sections.material import MATERIAL

    for path in (run.rollout, run.metrics, run.path / MATERIAL):
        path.unlink(missing_ok=True)


def _report(run: RunFolder, scene: Scene, dynamic: DynamicGaussians, progress: Progress) -> None:
    """Write report.html, and before it what the run lacks of rollout, material.json and metrics.json."""
    from masiv.report.numbers import material_numbers, run_numbers
    from masiv.report.video import write_report
    from masiv.twin import Twin

    progress("report", 0, 1)
    twin, trajectory = Twin.load(run.path), stages.load_trajectory(run)
    rollout = stages.rollout_of(run, twin, progress)
    if not stages.has_material(run):
        stages.describe_material(run, twin, progress)
    numbers = stages.read_metrics(run)
    if numbers is None:
        numbers = run_numbers(run, scene, dynamic, trajectory, rollout, progress=progress) | material_numbers(run)
        write_json(run.metrics, numbers)
    write_report(run, scene, dynamic, trajectory, twin, rollout, numbers)
    progress("report", 1, 1)


def _picture_errors(
    scene: Scene, dynamic: DynamicGaussians, rollouts: Mapping[str, np.ndarray], motion: Observed,
    observation: VideoObservation, progress: Progress,
) -> dict[str, dict[str, dict[str, Any]]]:  # fmt: skip
    """By the names of ``rollouts`` (T, Q, 3): Chamfer to the ``motion`` that was followed, and pictures against the
    video, over the frames of each part of ``observation``."""
    from masiv import metrics
    from masiv.report.follow import Binding
    from masiv.report.pictures import GaussiansAt, score_pictures

    def moved(positions: np.ndarray) -> GaussiansAt:
        binding = Binding.at_rest(dynamic.at(0.0), positions[0])
        return lambda frame: binding.moved(positions[frame])

    models = {name: moved(positions) for name, positions in rollouts.items()}
    views = list(range(len(scene.cameras)))
    out: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in rollouts}
    samples = observation.samples_per_frame
    for split, part in observation.parts.items():
        frames = list(range(1 + part.start // samples, 1 + part.stop // samples))
        scores = score_pictures(scene, models, frames, progress=progress)
        for name, positions in rollouts.items():
            numbers = scores[name].mean(views, frames) or {}
            kept = {k: numbers[k] for k in ("psnr_db", "psnr_box_in_scene_db", "ssim", "mask_iou") if k in numbers}
            chamfer = [metrics.chamfer_1e3mm2(positions[f], motion.positions[f]) for f in frames]
            out[name][split] = {"frames": frames, "chamfer_1e3mm2": float(np.mean(chamfer)), **kept}
    return out
