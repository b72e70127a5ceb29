"""What metrics.json and evaluate.json hold. Blocks carry the frames and views that they were taken on."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv import metrics
from masiv.progress import Progress, silent
from masiv.report import measure
from masiv.report.follow import Binding
from masiv.report.pictures import GaussiansAt, PictureScores, score_pictures
from masiv.report.sections.material import read_material
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin


def _views(run: RunFolder, scene: Scene) -> tuple[list[int], list[int]]:
    held_out = list(run.holdout_cameras)
    return [view for view in range(len(scene.cameras)) if view not in held_out], held_out


def reconstruction_numbers(
    run: RunFolder, scene: Scene, dynamic: DynamicGaussians, *, progress: Progress = silent
) -> dict[str, Any]:
    """Pictures of the Gaussians on the fitted frames, seen and held-out cameras apart; or point clouds."""
    frames = list(range(run.fit_frames))
    at = _reconstruction(scene, dynamic)
    if scene.load_cloud is not None:
        return {"point_clouds": measure.cloud_numbers(scene, at, frames)}
    scores = score_pictures(scene, {"reconstruction": at}, frames, progress=progress)["reconstruction"]
    return _by_cameras(run, scene, scores, frames)


def both_numbers(
    run: RunFolder, scene: Scene, dynamic: DynamicGaussians, rollout: np.ndarray, *, progress: Progress = silent
) -> dict[str, dict[str, Any]]:
    """``reconstruction_numbers`` as "reconstruction". As "twin" pictures of the Gaussians moved by the twin's
    particles, over fitted and future frames, on every camera; or point clouds."""
    binding = Binding.at_rest(dynamic.at(0.0), rollout[0])
    splits = dict(_split(run))
    twin = {"twin": lambda f: binding.moved(rollout[f])}
    if scene.load_cloud is not None:
        clouds = {split: measure.cloud_numbers(scene, twin["twin"], frames) for split, frames in splits.items()}
        return {"reconstruction": reconstruction_numbers(run, scene, dynamic), "twin": clouds}
    models = {"reconstruction": _reconstruction(scene, dynamic), **twin}
    observed = score_pictures(scene, models, splits["observed"], progress=progress)
    future = score_pictures(scene, twin, splits["future"], progress=progress)
    views = list(range(len(scene.cameras)))
    return {
        "reconstruction": _by_cameras(run, scene, observed["reconstruction"], splits["observed"]),
        "twin": {
            split: scores["twin"].mean(views, splits[split])
            for split, scores in (("observed", observed), ("future", future))
        },
    }


def _reconstruction(scene: Scene, dynamic: DynamicGaussians) -> GaussiansAt:
    return lambda frame: dynamic.at(frame / scene.fps)


def _by_cameras(run: RunFolder, scene: Scene, scores: PictureScores, frames: Sequence[int]) -> dict[str, Any]:
    training, held_out = _views(run, scene)
    return {"training_views": scores.mean(training, frames), "held_out_views": scores.mean(held_out, frames)}


def _split(run: RunFolder) -> tuple[tuple[str, list[int]], ...]:
    return (
        ("observed", list(range(run.fit_frames))),
        ("future", list(range(run.fit_frames, run.frame_count))),
    )


def run_numbers(
    run: RunFolder, scene: Scene, dynamic: DynamicGaussians, trajectory: Trajectory, rollout: np.ndarray, *,
    progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """metrics.json of ``masiv identify`` but for ``material_numbers``: no ground truth is needed."""
    return {
        "schema": 1,
        "units": measure.UNITS,
        **both_numbers(run, scene, dynamic, rollout, progress=progress),
        "fit": measure.agreement(rollout, trajectory.positions),
        "trajectory": {
            "particles": int(trajectory.positions.shape[1]),
            "spacing_m": float(trajectory.spacing),
            "volume_m3": float(trajectory.volume),
            **_volume_error(trajectory),
            **_mirror_plane(trajectory),
        },
        "seconds": run.seconds(),
    }


def _volume_error(trajectory: Trajectory) -> dict[str, float]:
    error = float(trajectory.volume * trajectory.volume_log_sd)
    return {"volume_standard_error_m3": error} if np.isfinite(error) else {}


def _mirror_plane(trajectory: Trajectory) -> dict[str, Any]:
    mirror = trajectory.mirror
    if mirror is None:
        return {}
    return {"mirror_plane": {"normal": mirror.normal.tolist(), "offset_m": float(mirror.offset)}}


def material_numbers(run: RunFolder) -> dict[str, Any]:
    """What metrics.json says of the material, which is described by another process."""
    material = read_material(run.path)
    return {} if material is None else {"material": {"summary": material["summary"]}}


def evaluation_numbers(
    run: RunFolder,
    scene: Scene | None,
    dynamic: DynamicGaussians,
    trajectory: Trajectory,
    twin: Twin | None,
    rollout: np.ndarray | None,
    truth_folder: Path,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """evaluate.json: against the true particles. ``twin`` and ``rollout`` are None where identify has not run. Without
    ``scene`` there are no numbers of pictures.

    The baselines start as the twin does, or, without one, as the first step of the trajectory does.
    """
    truth = measure.read_truth(truth_folder, run.frame_count)
    measure.require_same_body(truth[0], trajectory.positions[0], truth_folder)
    seed = int(run.config["seed"])
    motions = {"trajectory": trajectory.positions}
    rest = trajectory.positions[0].astype(np.float64)
    velocity, omega = measure.initial_motion(trajectory.positions, trajectory.times, run.gravity)
    if rollout is not None and twin is not None:
        motions["twin"] = rollout
        rest, velocity, omega = rollout[0].astype(np.float64), np.array(twin.velocity), np.array(twin.omega)
    motions |= measure.baselines(rest, velocity, omega, run.gravity, run.times, run.ground)
    motion: dict[str, dict[str, Any]] = {}
    for done, (name, positions) in enumerate(motions.items()):
        progress("evaluate", done, len(motions))
        motion[name] = {
            split: measure.motion_numbers(positions, truth, frames, seed=seed) for split, frames in _split(run)
        }
    progress("evaluate", len(motions), len(motions))
    floor = [metrics.chamfer_floor(points, seed=seed) for points in truth]
    pictures: dict[str, Any] = {"reconstruction": None, "twin": None}
    if scene is not None and rollout is not None:
        pictures = both_numbers(run, scene, dynamic, rollout, progress=progress)
    elif scene is not None:
        pictures["reconstruction"] = reconstruction_numbers(run, scene, dynamic, progress=progress)
    return {
        "schema": 1,
        "units": measure.UNITS,
        "truth": {"folder": str(truth_folder), "frames": len(truth), "particles": int(truth.shape[1])},
        "chamfer_floor_1e3mm2": float(np.mean(floor)),
        "baseline_start": {"velocity_m_s": velocity.tolist(), "omega_rad_s": omega.tolist()},
        "motion": motion,
        **pictures,
    }


MAX_SPANS = 4
"""Parts of a list of frames or views in a table."""
COLUMNS = {
    "psnr_box_in_scene_db": "PSNR box, in scene [dB]",
    "psnr_box_db": "PSNR box, on black [dB]",
    "psnr_db": "PSNR [dB]",
    "ssim": "SSIM",
    "mask_iou": "mask IoU",
    "chamfer_1e3mm2": "Chamfer [10³ mm²]",
    "tracked_error_mm": "tracked [mm]",
    "trajectory_rmse_mm": "to trajectory [mm]",
}


def blocks(numbers: Mapping[str, Any], name: str = "") -> list[tuple[str, Mapping[str, Any]]]:
    """The nested blocks that hold measured numbers, with their names in words."""
    if "frames" in numbers and any(column in numbers for column in COLUMNS):
        return [(name, numbers)]
    found = []
    for key, value in numbers.items():
        if isinstance(value, Mapping):
            found += blocks(value, f"{name}, {key.replace('_', ' ')}" if name else key.replace("_", " "))
    return found


def rows(numbers: Mapping[str, Any]) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of a table of ``numbers``: one row a block, one column a metric that any block has."""
    found = [(name, block) for name, block in blocks(numbers)]
    used = [key for key in COLUMNS if any(key in block for _, block in found)]
    body = [
        [name, _span(block.get("frames")), _span(block.get("views")), *(block.get(key) for key in used)]
        for name, block in found
    ]
    return ["what", "frames", "views", *(COLUMNS[key] for key in used)], body


def table(numbers: Mapping[str, Any]) -> str:
    """``rows`` as plain text."""
    from masiv.report.page import number

    header, body = rows(numbers)
    cells = [header, *([number(value) for value in row] for row in body)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    floor = numbers.get("chamfer_floor_1e3mm2")
    if floor is not None:
        lines.append(f"floor of Chamfer by sampling: {floor:.3g} 10³ mm²")
    if "material" in numbers:
        lines.append("\n".join(textwrap.wrap(numbers["material"]["summary"], 110)))
    return "\n".join(lines)


def _span(indices: list[int] | None) -> str | None:
    """[0, 1, 2, 5] -> '0–2, 5'; if that would be more than ``MAX_SPANS`` parts, '21 of 0–119'."""
    if not indices:
        return None
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    if len(runs) > MAX_SPANS:
        return f"{len(indices)} of {indices[0]}–{indices[-1]}"
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)


def law_text(law: Mapping[str, Any], families: Sequence[Mapping[str, Any]]) -> str:
    """A law's parameters with their standard errors, and the error of each family if several were fitted."""
    lines = [f"law      {law['kind']}"]
    for name, entry in law["parameters"].items():
        line = f"         {name.replace('_', ' ')} {entry['value']:.4g} {entry['unit']}"
        if "stderr" in entry:
            known = entry["stderr"] is not None
            line += f" ± {entry['stderr']:.2g}" if known else " (the motion does not determine it)"
        lines.append(line)
    for row in families:
        if "failed" in row:
            lines.append(f"         {row['law']}: failed, {row['failed']}")
            continue
        loss = row.get("image_loss", row.get("picture_error"))  # named otherwise in runs of older versions
        rank = f"BIC {row['bic_above_best']:.0f} above the best" if loss is None else f"image loss {loss:.3f}"
        lines.append(f"         {row['law']}: {row['trajectory_error_mm']:.1f} mm from the paths, {rank}")
    return "\n".join(lines) + "\n"


def given_or_error(stderr: float | None) -> str:
    """A standard error for a terminal; a value without one was given, not fitted."""
    return " (given)" if stderr is None else f" ± {stderr:.2g}"
