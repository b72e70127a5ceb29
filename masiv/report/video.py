"""``report.html``: what was seen, what was made of it, and how well it agrees."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from masiv.metrics import mask_box
from masiv.report import plots
from masiv.report.draw import draw, on_black
from masiv.report.film import joined
from masiv.report.follow import Binding
from masiv.report.history import curves
from masiv.report.media import write_video
from masiv.report.numbers import rows
from masiv.report.page import Page
from masiv.report.sections.material import material_section, read_material
from masiv.report.sections.refinement import read_refined, refinement_section
from masiv.report.sections.twin import twin_section
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin

VIDEO_VIEWS = 2
SLOWER = 4  # a fall lasts half a second: shown at real speed, nothing is seen
GREY = 90


def write_report(
    run: RunFolder,
    scene: Scene,
    dynamic: DynamicGaussians,
    trajectory: Trajectory,
    twin: Twin,
    rollout: np.ndarray,
    numbers: Mapping[str, Any],
) -> None:
    """Write the run's report.html. ``numbers`` is what metrics.json holds, rollout (T, Q, 3) [m] covers every frame."""
    training = [view for view in range(len(scene.cameras)) if view not in run.holdout_cameras]
    page = Page(f"Digital twin of {scene.path.resolve().name}")
    seen = "Point clouds" if scene.load_cloud is not None else f"{len(scene.cameras)} cameras"
    if scene.depth_noise is not None:
        seen += " with depth"
    page.note(
        f"{seen}, {scene.frame_count} frames at {scene.fps:g} fps; fitted on frames 0 to "
        f"{run.fit_frames - 1}; cameras kept out of the fit: {', '.join(map(str, run.holdout_cameras)) or 'none'}."
    )
    if len(training) == 1:
        page.note(
            "One camera saw the object: the side that it did not see is a guess, as deep as the silhouette is wide."
        )
    if scene.cameras:
        page.heading("Observed, reconstructed, simulated")
    for view in shown_views(run, scene):
        role = "not seen by the fit" if view in run.holdout_cameras else "seen by the fit"
        page.video(
            comparison_video(run, scene, dynamic, rollout, view),
            f"Camera {view}, {role}, {SLOWER}× slower. Left: observed. Middle: reconstruction, fitted frames only. "
            "Right: twin, simulated from frame 0.",
        )
    page.heading("Numbers")
    page.table(*rows(numbers))
    page.note("PSNR and SSIM: object on black. 'to trajectory' is what the fit made small, no ground truth.")
    twin_section(page, twin)
    material = read_material(run.path)
    if material is None:
        page.picture(plots.law_curves(twin.law), "stress of the identified law")
    else:
        material_section(page, material)
    refined = read_refined(run.path)
    if refined is not None:
        refinement_section(page, *refined, scene.up)
    page.heading("Motion")
    fit_end = (run.fit_frames - 1) / scene.fps
    motions = {"trajectory": (trajectory.positions, trajectory.times), "twin": (rollout, scene.times)}
    page.picture(plots.centroid_path(motions, scene.up, fit_end), "path of the centroid")
    fit = numbers["fit"]["trajectory_rmse_mm_by_frame"]
    page.picture(
        plots.over_frames({"twin": (range(len(fit)), fit)}, "twin to trajectory", "RMSE [mm]", run.fit_frames),
        "distance between twin and trajectory",
    )
    if scene.cameras:
        page.picture(_picture_curves(run, numbers), "PSNR over frames")
    else:
        page.picture(_cloud_curves(run, numbers), "distance to the point clouds over frames")
    losses = curves(run.log)
    if losses:
        page.heading("Convergence")
        page.picture(plots.loss_curves(losses), "what each stage reported")
    page.heading("How it was made")
    page.table(["stage", "seconds"], [[name, float(value)] for name, value in run.seconds().items()])
    versions = ", ".join(f"{name} {version}" for name, version in run.record["versions"].items())
    page.note(f"Preset {run.config['preset']}, seed {run.config['seed']}, {versions}. All settings: run.yaml.")
    page.write(run.report)


def shown_views(run: RunFolder, scene: Scene) -> list[int]:
    """A held-out camera first, where there is one, then training cameras."""
    training = [view for view in range(len(scene.cameras)) if view not in run.holdout_cameras]
    return [*run.holdout_cameras, *training][:VIDEO_VIEWS]


def comparison_frames(
    run: RunFolder, scene: Scene, dynamic: DynamicGaussians, rollout: np.ndarray, view: int, height: int = 360
) -> list[np.ndarray]:
    """Observed | reconstruction | twin, one picture a frame, ``height`` pixels high, cut to where the object ever is.

    Grey where there is none.
    """
    camera = scene.cameras[view]
    binding = Binding.at_rest(dynamic.at(0.0), rollout[0])
    triples = []
    ever = np.zeros((camera.height, camera.width), np.float32)
    for frame in range(scene.frame_count):
        observed = scene.frame(view, frame)
        seen = on_black(observed.image, observed.mask)
        made = np.full_like(seen, GREY)
        if frame < run.fit_frames:
            made, _ = draw(dynamic.at(frame / scene.fps), camera)
        simulated, alpha = draw(binding.moved(rollout[frame]), camera)
        ever = np.maximum(ever, np.maximum(observed.mask, alpha))
        triples.append((seen, made, simulated))
    box = mask_box(ever, margin=6) or (slice(None), slice(None))
    pictures = []
    for seen, made, simulated in triples:
        gap = np.full((seen[box].shape[0], 2, 3), 255, np.uint8)
        row = joined([seen[box], gap, made[box], gap, simulated[box]])
        width = round(row.shape[1] * height / row.shape[0])
        enlarge = cv2.INTER_LANCZOS4 if height > row.shape[0] else cv2.INTER_AREA
        pictures.append(cv2.resize(row, (width, height), interpolation=enlarge))
    return pictures


def comparison_video(run: RunFolder, scene: Scene, dynamic: DynamicGaussians, rollout: np.ndarray, view: int) -> bytes:
    """``comparison_frames`` as mp4."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "comparison.mp4"
        write_video(path, comparison_frames(run, scene, dynamic, rollout, view), scene.fps, repeat=SLOWER)
        return path.read_bytes()


def _cloud_curves(run: RunFolder, numbers: Mapping[str, Any]) -> bytes:
    named = {"reconstruction": [numbers["reconstruction"]["point_clouds"]], "twin": list(numbers["twin"].values())}
    found: dict[str, tuple[list[int], list[float | None]]] = {}
    for name, blocks in named.items():
        known = [block for block in blocks if block]
        frames = [frame for block in known for frame in block["frames"]]
        found[name] = frames, [value for block in known for value in block["chamfer_1e3mm2_by_frame"]]
    return plots.over_frames(found, "distance to the point clouds", "Chamfer [10³ mm²]", run.fit_frames)


def _picture_curves(run: RunFolder, numbers: Mapping[str, Any]) -> bytes:
    found: dict[str, tuple[list[int], list[float | None]]] = {}
    for name, block in (
        ("reconstruction, training cameras", numbers["reconstruction"]["training_views"]),
        ("reconstruction, held-out cameras", numbers["reconstruction"]["held_out_views"]),
    ):
        if block:
            found[name] = block["frames"], block["psnr_box_db_by_frame"]
    twin = [block for block in numbers["twin"].values() if block]
    frames = [frame for block in twin for frame in block["frames"]]
    found["twin, all cameras"] = frames, [value for block in twin for value in block["psnr_box_db_by_frame"]]
    return plots.over_frames(found, "agreement of pictures", "PSNR in the mask's box [dB]", run.fit_frames)
