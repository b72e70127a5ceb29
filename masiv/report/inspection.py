"""What was read of a scene, as numbers, as text and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from masiv.calibration.clocks import clocks, late_cameras
from masiv.calibration.consistency import consistency, odd_camera, pairs_of, tangency_series
from masiv.calibration.mask_flicker import flicker, flickering_masks, hole_share
from masiv.calibration.outline_points import area_middles, ray_centres
from masiv.calibration.tangency import Outline, outline
from masiv.hull.first_frame import first_frame_problems
from masiv.hull.mask_quality import mask_quality
from masiv.identifiability.answers import Identifiability, identifiability
from masiv.identifiability.fall import fall_problem, wrong_scale
from masiv.identifiability.from_scene import scene_motion
from masiv.identifiability.from_tracks import track_motion
from masiv.identifiability.held_tracks import held_problems
from masiv.identifiability.motion import ObservedMotion
from masiv.observations.identity import identity
from masiv.report.contact_sheet import Marks, write_contact_sheet
from masiv.report.world_marks import round_length
from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Scene
from masiv.scene.summary import as_text, summarise
from masiv.tracks.summary import summarise_tracks, tracks_as_text, write_tracks_picture
from masiv.tracks.tracks import Tracks


def inspection(read: Scene | Tracks, picture: Path) -> tuple[dict[str, Any], str]:
    """Summary and text of what was read; draws it to ``picture`` (PNG)."""
    if isinstance(read, Tracks):
        write_tracks_picture(read, picture)
        summary = {**summarise_tracks(read), "picture": str(picture)}
        motions = [found for run in read.runs if (found := track_motion(read, run)) is not None]
        for motion in motions:
            summary["problems"] += _fall_problems(motion, motion.times, motion.centre, f"run {motion.name}: ")
        summary["problems"] += held_problems(read)
        return _with_answers(summary, motions, tracks_as_text)
    looked = _Looked(read)
    summary = {**summarise(read, looked.at), **identity(read), "picture": str(picture)}
    path, notes = None, {}
    if read.cameras:
        path, notes = _inspect_cameras(read, looked, summary)
    first = first_frame_problems(read)
    summary["problems"] += first
    motion = scene_motion(read, path)
    if motion is not None:
        # Hulls are cut at the ground, which is wrong with the axis; rays are not.
        times, centre = (motion.times, motion.centre) if path is None else (path[0] / read.fps, path[1])
        summary["problems"] += _fall_problems(motion, times, centre)
    marks = None if motion is None else Marks(motion.centre[0], round_length(0.5 * motion.size))
    write_contact_sheet(read, picture, notes, marks)
    return _with_answers(summary, [] if motion is None else [motion], as_text)


def _with_answers(summary: dict[str, Any], motions: list[ObservedMotion], text) -> tuple[dict[str, Any], str]:
    found = [identifiability(motion) for motion in motions]
    summary["identifiability"] = [one.summary() for one in found]
    lines = text(summary).splitlines()
    return summary, "\n".join([*lines[:-1], *_answer_lines(found), lines[-1]])  # the last is the picture


def _answer_lines(found: list[Identifiability]) -> list[str]:
    lines = []
    for one in found:
        lines += [f"what the motion of {one.recording} tells (estimates)", *one.lines()]
    return lines


def _fall_problems(motion: ObservedMotion, times: np.ndarray, centre: np.ndarray, who: str = "") -> list[str]:
    """centre (T, 3) [m] at ``times`` (T,) [s], which may be more than those of ``motion``."""
    if motion.clamped:
        return []
    # The noise of a path by rays is known without the flight, which the ground cuts out.
    noise = motion.centre_std if centre is motion.centre else motion.floor
    wrong = fall_problem(times, centre, noise, motion.gravity)
    if wrong is None and motion.lowest is not None and motion.contact is not None:
        flies = times < motion.times[motion.contact]
        wrong = wrong_scale(times[flies], centre[flies], noise, motion.gravity)
    return [] if wrong is None else [who + wrong]


def _inspect_cameras(
    scene: Scene, looked: _Looked, summary: dict[str, Any]
) -> tuple[tuple[np.ndarray, np.ndarray], dict[int, str]]:
    """Numbers and problems of cameras and masks into ``summary``; frames (K,) and path (K, 3) [m] of the object, and
    a note for each view."""
    cameras = [scene.cameras[view] for view in scene.views]
    outlines, holes = looked.outlines, looked.holes
    series = tangency_series(cameras, outlines)
    agreement = consistency(scene.views, pairs_of(series))
    quality = mask_quality(scene)
    found, flickers = clocks(scene.views, cameras, looked.raw, scene.fps), flicker(scene.views, series, holes)
    rows = summary["cameras"]
    for k, view in enumerate(scene.views):
        rows[view]["consistency_px"] = _plain(agreement.pixels[k])
        rows[view]["mask_agreement"] = _plain(quality.agreement[k])
        rows[view]["mask_doubt"] = _plain(quality.doubt[k])
        rows[view]["time_offset_ms"] = None if found is None else 1e3 * float(found.offsets[k])
        rows[view]["time_offset_error_ms"] = None if found is None else 1e3 * float(found.standard_errors[k])
        rows[view]["flickering_frames"] = list(flickers.frames[k])
    late = {} if found is None else late_cameras(scene, found, agreement)
    odd = None if agreement.suspect in late else odd_camera(scene, agreement)
    summary["problems"] += [*late.values(), *([] if odd is None else [odd])]
    # At another time, or from another place, every mask disagrees.
    summary["problems"] += flickering_masks(scene, flickers, {*late, agreement.suspect})
    summary["problems"] += quality.problems()
    frames, centres = ray_centres(cameras, area_middles(cameras, outlines))
    notes = {view: f"{error:.1f} px" for view, error in zip(agreement.views, agreement.pixels, strict=True)}
    return (frames, centres), notes


class _Looked:
    """What is kept of each picture of ``scene``. By view, then by frame: outlines, and raw, those of the masks before
    they are made to agree (masks that agree with each other agree at a wrong time, too); holes (V, F): ``hole_share``.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._row = {view: row for row, view in enumerate(scene.views)}
        self.outlines: list[list[Outline | None]] = [[] for _ in scene.views]
        self.raw = self.outlines if scene.correct_masks is None else [[] for _ in scene.views]
        self.holes = np.full((len(scene.views), scene.frame_count), np.nan)
        self._last: list[list[np.ndarray]] = [[] for _ in scene.views]

    def at(self, view: int, frame: int, picture: Frame) -> None:
        """Look at ``picture``; frames come in order."""
        row = self._row[view]
        self.outlines[row].append(outline(picture))
        if self.raw is not self.outlines:
            self.raw[row].append(outline(self._scene.load(view, frame)))
        last = self._last[row] = [*self._last[row][-2:], picture.mask > 0.5]
        if len(last) == 3:
            self.holes[row, frame - 1] = hole_share(*last)


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
