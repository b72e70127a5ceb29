"""``report.html``: the answer, what was seen, and how well the twin agrees with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.files import read_npz
from masiv.report.camera_view import camera_data
from masiv.report.charts import BLUE, ORANGE, Band, Chart
from masiv.report.history import curves
from masiv.report.law_charts import law_charts
from masiv.report.motion_view import Motion
from masiv.report.numbers import rows
from masiv.report.page import Page
from masiv.report.sections.answer import Agreement, answer_cards
from masiv.report.sections.evaluation import evaluation_section, read_evaluation, true_errors
from masiv.report.sections.material import material_section, read_material
from masiv.report.sections.player import player_section
from masiv.report.sections.refinement import read_refined, refinement_section
from masiv.report.sections.twin import fit_table, twin_section
from masiv.report.time_charts import centroid_charts, convergence, over_time
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene
from masiv.simulation.subdivide import merge_subparticles

if TYPE_CHECKING:
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin

GROWTH = (
    "The twin is simulated from frame 0 on and never corrected, so what is wrong with it adds up: an error that grows "
    "with time is what to expect, and its slope says how fast the twin and the object part. Frames after the "
    "fit are a forecast."
)


def write_report(
    run: RunFolder,
    scene: Scene,
    dynamic: DynamicGaussians,
    trajectory: Trajectory,
    twin: Twin,
    rollout: np.ndarray,
    numbers: Mapping[str, Any],
) -> None:
    """Write the run's report.html. ``numbers`` is what metrics.json holds, rollout (T, Q p, 3) [m] covers every
    frame."""
    page = Page(f"Digital twin of {scene.path.resolve().name}")
    page.note(_recorded(run, scene))
    material, refined = read_material(run.path), read_refined(run.path)
    evaluation = read_evaluation(run.evaluation)
    motion = _motion(run, scene, trajectory, rollout)
    documents = [] if refined is None else [refined[0]]
    size = float(np.ptp(trajectory.positions[0], axis=0).max())
    page.cards(answer_cards(twin, material, documents, _agreements(numbers, evaluation), size))
    cameras = camera_data(run, scene, dynamic, rollout) if scene.cameras else []
    player_section(page, [motion, *_before(refined, scene, motion)], scene.up, scene.ground, cameras)
    if len(scene.cameras) - len(run.holdout_cameras) == 1:
        page.note(
            "One camera saw the object: the side that it did not see is a guess, as deep as the silhouette is wide."
        )
    bands = _bands(run, scene)
    page.heading("How the error grows")
    page.charts([_growth(motion, evaluation, bands), *_appearance(run, scene, numbers, bands)])
    if evaluation is not None:
        evaluation_section(page, evaluation)
    if refined is not None:
        refinement_section(page, *refined, scene.up)
    if material is None:
        page.heading("The law")
        page.charts(law_charts(twin.law))
    else:
        material_section(page, material)
    page.heading("Motion")
    motions = {"observed": (trajectory.positions, trajectory.times), "twin": (rollout, scene.times)}
    page.charts(centroid_charts(motions, scene.up, bands))
    twin_section(page, twin)
    reported = curves(run.log)
    if reported:
        page.heading("Convergence of the fits")
        page.charts([convergence(stage, values) for stage, values in reported.items()])
    page.heading("Numbers and settings")
    page.table(*rows(numbers))
    page.note(
        "PSNR and SSIM: object on black. Observed, future: frames that were fitted, and later ones. To trajectory: "
        "distance to the motion that was estimated from the recording, which the fit made small; no ground truth."
    )
    with page.folded("Settings, versions, time"):
        page.table(["stage", "seconds"], [[name, float(value)] for name, value in run.seconds().items()])
        fit_table(page, twin)
        versions = ", ".join(f"{name} {version}" for name, version in run.record["versions"].items())
        page.note(f"Preset {run.config['preset']}, seed {run.config['seed']}, {versions}. All settings: run.yaml.")
    page.write(run.report)


def _recorded(run: RunFolder, scene: Scene) -> str:
    seen = "Point clouds" if scene.load_cloud is not None else f"{len(scene.cameras)} cameras"
    if scene.depth_noise is not None:
        seen += " with depth"
    return (
        f"{seen}, {scene.frame_count} frames at {scene.fps:g} fps; fitted on frames 0 to "
        f"{run.fit_frames - 1}; cameras kept out of the fit: {', '.join(map(str, run.holdout_cameras)) or 'none'}."
    )


def _motion(run: RunFolder, scene: Scene, trajectory: Trajectory, rollout: np.ndarray) -> Motion:
    """The twin and what was observed: held-out frames as well, if ``refine`` has measured them."""
    observed = trajectory.positions
    held_out = run.path / "held_out" / "trajectory.npz"
    if held_out.is_file():
        longer = read_npz(held_out)["positions"]
        observed = longer if longer.shape[1] == observed.shape[1] else observed
    seen = np.full((len(rollout), observed.shape[1], 3), np.nan)
    seen[: len(observed)] = observed[: len(rollout)]
    merged = merge_subparticles(rollout.astype(np.float64), observed.shape[1])
    return Motion("twin", scene.times[: len(rollout)], merged, seen, _parts(run, scene))


def _before(
    refined: tuple[Mapping[str, Any], Mapping[str, np.ndarray]] | None, scene: Scene, twin: Motion
) -> list[Motion]:
    """The fits of ``refine`` without and with what it added, at the frames of ``twin``; none if nothing was added."""
    if refined is None or not refined[0]["accepted"]:
        return []
    fields = refined[1]
    instants = np.round(np.asarray(fields["times"]) * scene.fps, 6)
    whole = np.flatnonzero(instants == np.round(instants))
    frames = instants[whole].astype(int)
    inside = frames < len(twin.times)
    frames, whole = frames[inside], whole[inside]
    found = []
    for key, name in (("before", "best fit without the effect"), ("after", "the same with the effect")):
        seen = np.full((len(twin.times), *fields["points"].shape), np.nan)
        seen[0], seen[frames] = fields["points"], fields["observed"][whole]
        made = seen.copy()
        made[frames] += fields[key][whole]
        found.append(Motion(name, twin.times, made, seen, twin.parts))
    return found


def _parts(run: RunFolder, scene: Scene) -> list[tuple[int, str]]:
    return [(run.fit_frames, "fitted"), (scene.frame_count - run.fit_frames, "not fitted")]


def _bands(run: RunFolder, scene: Scene) -> list[Band]:
    """Fitted frames, and the others if there are any."""
    if run.fit_frames >= scene.frame_count:
        return []
    border, end = (run.fit_frames - 0.5) / scene.fps, (scene.frame_count - 0.5) / scene.fps
    return [
        Band(-0.5 / scene.fps, border, "fitted", BLUE, 0.07),
        Band(border, end, "not fitted", ORANGE, 0.13),
    ]


def _agreements(numbers: Mapping[str, Any], evaluation: Mapping[str, Any] | None) -> list[Agreement]:
    found = []
    for part, on in (("future", "frames after the fit"), ("observed", "fitted frames")):
        block = ((evaluation or {}).get("motion", {}).get("twin") or {}).get(part)
        if block:
            found.append(Agreement(block["tracked_error_mm"], f"mean distance from the true motion on {on}"))
    fit = numbers.get("fit") or {}
    if "trajectory_rmse_mm" in fit:
        found.append(Agreement(fit["trajectory_rmse_mm"], "RMS to the motion seen in the recording, on fitted frames"))
    return found


def _growth(motion: Motion, evaluation: Mapping[str, Any] | None, bands: list[Band]) -> Chart:
    errors = motion.error_mm
    rms = [float(np.sqrt(np.nanmean(e**2))) if np.isfinite(e).any() else None for e in errors]
    shown: dict[str, Any] = {"twin to observed motion, RMS": (motion.times, rms)}
    for name, frames, values in true_errors(evaluation):
        shown[f"{name} to true motion, mean"] = motion.times[frames], values
    return over_time(shown, "Distance of the particles", "distance [mm]", bands, note=GROWTH)


def _appearance(run: RunFolder, scene: Scene, numbers: Mapping[str, Any], bands: list[Band]) -> list[Chart]:
    """Pictures, or point clouds, over time."""
    key = "psnr_box_db_by_frame" if scene.cameras else "chamfer_1e3mm2_by_frame"
    blocks = {"twin": [block for block in numbers["twin"].values() if block]}
    if scene.cameras:
        blocks["reconstruction, training cameras"] = [numbers["reconstruction"]["training_views"]]
        blocks["reconstruction, cameras kept out"] = [numbers["reconstruction"]["held_out_views"]]
    else:
        blocks["reconstruction"] = [numbers["reconstruction"]["point_clouds"]]
    shown = {}
    for name, own in blocks.items():
        known = [block for block in own if block]
        if known:
            frames = np.array([frame for block in known for frame in block["frames"]], dtype=int)
            shown[name] = scene.times[frames], [value for block in known for value in block[key]]
    if scene.cameras:
        note = "Larger is better: 30 dB is hard to tell from the recording, 20 dB shows clear shifts."
        return [
            over_time(shown, "Agreement of pictures", "PSNR in the mask's box [dB]", bands, note=note, from_zero=False)
        ]
    return [over_time(shown, "Distance to the point clouds", "Chamfer [10³ mm²]", bands)]
