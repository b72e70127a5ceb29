"""What ``masiv view`` shows of a run, and the page that shows it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.continuum.trajectory import Trajectory
from masiv.errors import InputError
from masiv.files import read_npz
from masiv.pipeline import stages
from masiv.pipeline.requests import Summary, ViewRequest, refuse
from masiv.scene.calibration import Calibration
from masiv.simulation.simulate import MAX_FRAMES
from masiv.strict import quoted
from masiv.twin import Twin
from masiv.view.page import open_page
from masiv.view.subject import Subject

if TYPE_CHECKING:
    from masiv.pipeline.run import Run
    from masiv.pipeline.tracks import TracksRun
    from masiv.pipeline.video import VideoRun
    from masiv.scene.scene import Scene

DEFAULT_FRAMES = 60
"""Of a motion that was not observed as such."""


def view(run: Run, request: ViewRequest, ready: Callable[[Summary], None]) -> None:
    """Serve the page of ``run`` until Ctrl-C; ``ready`` is told its address. Raises InputError."""
    run.folder.require("identify")
    if request.frames is not None and not 2 <= request.frames <= MAX_FRAMES:
        raise InputError(f"--frames {quoted(request.frames)}: give 2 to {MAX_FRAMES}")
    subject = run.subject(request)
    with open_page(subject, host=request.host, port=request.port, arch=run.config.arch) as page:
        address = f"http://{page.server.get_host()}:{page.server.get_port()}"
        ready(Summary({"address": address}, f"{subject.title} is at {address} (Ctrl-C ends it)"))
        page.run()


def video_subject(run: VideoRun, request: ViewRequest) -> Subject:
    """Of a run of pictures or point clouds. Raises InputError."""
    refuse(request, ("condition",), "tracks", run.scene_path)
    other = None
    if request.law is not None:
        other = Twin.load(stages.require_run(request.law, "--law"))
    held_out = run.path / "held_out" / "trajectory.npz"
    trajectory = Trajectory.load(held_out) if held_out.is_file() else stages.load_trajectory(run.folder)
    calibration = Calibration.load(run.path)
    scene = run.scene if run.scene_path.exists() else None
    cameras = scene.cameras if scene is not None else () if calibration is None else calibration.refined
    notes = []
    if scene is None:
        notes.append(f"The scene is not at {run.scene_path}: cameras have no pictures. --scene says where it is.")
    return Subject(
        run.path.resolve().name,
        Twin.load(run.path),
        request.frames or run.folder.frame_count,
        observed=trajectory.positions,
        gaussians=stages.load_gaussians(run.folder).at(0.0),
        cameras=cameras,
        picture=pictures(scene),
        other=other,
        other_name="" if request.law is None else request.law.resolve().name,
        notes=tuple(notes),
    )


def pictures(scene: Scene | None) -> Callable[[int, int], np.ndarray | None]:
    """(view, frame) -> the picture as it was taken, without the masks that reading it may estimate."""

    def picture(view: int, frame: int) -> np.ndarray | None:
        if scene is None or frame >= scene.frame_count or (view, frame) in scene.missing:
            return None
        if scene.load_with_mask is None:
            return scene.load(view, frame).image
        camera = scene.cameras[view]
        return scene.load_with_mask(view, frame, np.zeros((camera.height, camera.width), np.float32)).image

    return picture


def tracks_subject(run: TracksRun, request: ViewRequest) -> Subject:
    """Of a run of tracks: the first recording of the condition. Raises InputError."""
    refuse(request, ("law",), "pictures", run.scene_path)
    twin = run.load_twin().in_condition(request.condition)
    observed, notes = None, []
    frames = request.frames
    if twin.rigid:
        notes.append("Bodies in flight are points: they have no stress and no strain.")
    else:
        found = observed_markers(run.folder.rollout, twin)
        if found is None:
            notes.append("Markers were not measured along three axes, or rollout.npz is missing: they are not shown.")
        else:
            observed = found if frames is None else found[:frames]
            frames = frames or len(found)
    return Subject(
        run.path.resolve().name, twin, frames or DEFAULT_FRAMES, observed=observed, notes=tuple(notes)
    )  # fmt: skip


def observed_markers(rollout: Path, twin: Twin) -> np.ndarray | None:
    """Markers (T, M, 3) [m, world] at k / fps of the twin's first observation, NaN if there is no sample within half a
    frame; None if they are not known along three axes."""
    if not rollout.is_file():
        return None
    file, name = read_npz(rollout), twin.initial_conditions[0].observation
    if f"observed@{name}" not in file:
        return None
    times, observed = np.asarray(file[f"times@{name}"]), np.asarray(file[f"observed@{name}"])
    if observed.ndim != 3 or observed.shape[2] != 3 or not len(times):
        return None
    wanted = np.arange(int(times[-1] * twin.fps) + 1) / twin.fps
    nearest = np.abs(times[None] - wanted[:, None]).argmin(1)
    found = observed[nearest].astype(np.float32)
    found[np.abs(times[nearest] - wanted) > 0.5 / twin.fps] = np.nan
    return found
