"""The stages of a run of pictures, each run if the folder lacks its artefacts."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv import runtime
from masiv.config import Config
from masiv.errors import InputError
from masiv.files import atomic_folder
from masiv.hull.first_frame import require_first_frame
from masiv.observations.kept_masks import with_kept_masks
from masiv.observations.read import read_scene
from masiv.pipeline.expected_memory import expected_memory
from masiv.progress import Progress, silent
from masiv.report.history import logged
from masiv.report.sections.material import MATERIAL, read_material
from masiv.runfolder import STAGES, RunFolder, load_motion
from masiv.scene.calibration import Calibration
from masiv.scene.listing import mapping
from masiv.scene.scene import Scene
from masiv.strict import read_json

if TYPE_CHECKING:
    import numpy as np

    from masiv.continuum.camera_split import CameraSplit
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.twin import Twin


def calibrated_scene(run: RunFolder, scene: Scene) -> Scene:
    """``scene`` with the cameras that the run's reconstruct stage refined; as it is where none were."""
    calibration = Calibration.load(run.path) if run.done("reconstruct") else None
    return scene if calibration is None else calibration.applied_to(scene)


def training_scene(run: RunFolder, scene: Scene) -> Scene:
    """``scene`` without held-out frames and cameras: what a stage that fits may see. Once there are Gaussians, its
    cameras are those that were refined with them, and masks that were estimated are theirs (``as_reconstructed``)."""
    visible = calibrated_scene(run, scene).restricted(run.fit_frames, run.holdout_cameras)
    if not (scene.masks_estimated and run.done("reconstruct")):
        return visible
    from masiv.splat.rendered_masks import as_reconstructed

    return as_reconstructed(visible, load_gaussians(run))


def motion_problems(run: RunFolder, scene: Scene, positions: np.ndarray) -> list[str]:
    """What is not measured in the motion ``positions`` (T, Q, 3) [m] of the first frames of ``scene``."""
    from masiv.continuum.in_view import view_problems

    return view_problems(scene.restricted(holdout_cameras=run.holdout_cameras), positions)


def load_gaussians(run: RunFolder) -> DynamicGaussians:
    """The result of a finished reconstruct stage. Raises InputError."""
    from masiv.splat.dynamic import DynamicGaussians

    run.require("reconstruct")
    return DynamicGaussians.load(run.path)


def load_trajectory(run: RunFolder) -> Trajectory:
    """The result of a finished trajectory stage. Raises InputError."""
    from masiv.continuum.trajectory import Trajectory

    run.require("trajectory")
    return Trajectory.load(run.trajectory)


def ensure_gaussians(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> DynamicGaussians:
    """The run's dynamic Gaussians; reconstructs them if they are missing."""
    runtime.start(config.arch)
    if run.done("reconstruct"):
        return load_gaussians(run)
    from masiv.splat.reconstruct import reconstruct

    if scene.masks_estimated:
        require_first_frame(training_scene(run, scene))
    with run.stage("reconstruct", _say_memory(run, "reconstruct", config, scene, progress)) as checkpoint:
        dynamic = reconstruct(
            training_scene(run, scene),
            config.reconstruct,
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        dynamic.save(run.path)
    scene.release_pictures()
    return dynamic


def ensure_trajectory(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Trajectory:
    """The run's trajectory; estimates it if it is missing."""
    runtime.start(config.arch)
    if run.done("trajectory"):
        return load_trajectory(run)
    from masiv.continuum.trajectory import estimate_trajectory

    dynamic = ensure_gaussians(run, config, scene, progress)
    with run.stage("trajectory", _say_memory(run, "trajectory", config, scene, progress)) as checkpoint:
        trajectory = estimate_trajectory(
            training_scene(run, scene),
            dynamic,
            config.trajectory,
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        trajectory.save(run.trajectory)
    scene.release_pictures()
    return trajectory


def ensure_twin(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Twin:
    """The run's twin; identifies it if it is missing."""
    runtime.start(config.arch)
    from masiv.identification.stage import identify
    from masiv.twin import Twin

    if run.done("identify"):
        return Twin.load(run.path)
    trajectory = ensure_trajectory(run, config, scene, progress)
    particles = trajectory.positions.shape[1]
    expected = _say_memory(run, "identify", config, scene, progress, particles)
    with run.stage("identify", expected) as checkpoint:
        twin = identify(
            training_scene(run, scene),
            trajectory,
            config.identify,
            config.simulator,
            others=other_recordings(config),
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        (run.path / MATERIAL).unlink(missing_ok=True)  # of an earlier twin
        twin.save(run.path)
    scene.release_pictures()
    return twin


def require_memory(run: RunFolder, config: Config, scene: Scene, last: str) -> None:
    """Raises InputError if a stage that is missing, up to ``last``, would not fit into memory."""
    visible = scene.restricted(run.fit_frames, run.holdout_cameras)
    for stage in STAGES[: STAGES.index(last) + 1]:
        if not run.done(stage):
            expected_memory(stage, visible, config).require(config.memory_limit_mb)


def _say_memory(
    run: RunFolder, stage: str, config: Config, scene: Scene, progress: Progress, particles: int | None = None
) -> float:
    """Say how much memory the stage is expected to take [MB]. Raises InputError if that is too much."""
    visible = scene.restricted(run.fit_frames, run.holdout_cameras)
    return expected_memory(stage, visible, config, particles).announce(config.memory_limit_mb, progress)


def other_recordings(config: Config) -> list[tuple[Scene, Trajectory]]:
    """The other recordings of the same object that a law is learnt from, without their held-out frames and cameras."""
    runs = [RunFolder.open(Path(path)) for path in config.identify.also]
    scenes = [with_kept_masks(read_scene(run.scene_path), run.masks) for run in runs]
    return [(training_scene(run, scene), load_trajectory(run)) for run, scene in zip(runs, scenes, strict=True)]


def ensure_held_out_trajectory(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Trajectory | None:
    """The run's particles through all frames of ``scene``, held-out frames included; None if none was held out.

    Held-out frames are measured after every fit, and no fit sees them. Frames before ``run.fit_frames`` are those of
    the run. Made once: RUN/held_out keeps it. Raises InputError if the run has no trajectory yet.
    """
    if run.fit_frames >= scene.frame_count:
        return None
    from masiv.continuum.extend_trajectory import extend_trajectory
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.splat.extend_frames import ExtendFramesConfig, extend_frames
    from masiv.splat.rendered_masks import as_reconstructed

    folder = run.path / "held_out"
    path = folder / "trajectory.npz"
    if path.is_file():
        return Trajectory.load(path)
    runtime.start(config.arch)
    given = load_trajectory(run)
    visible = calibrated_scene(run, scene).restricted(holdout_cameras=run.holdout_cameras)
    folder.mkdir(exist_ok=True)
    checkpoint = run.checkpoint("held_out_gaussians")
    if not (folder / "deformation.safetensors").is_file():
        extended = extend_frames(
            visible,
            load_gaussians(run),
            config.reconstruct,
            ExtendFramesConfig.model_validate({}),
            seed=config.seed,
            checkpoint=checkpoint,
            progress=progress,
        )
        extended.save(folder)
    checkpoint.clear()
    checkpoint = run.checkpoint("held_out_trajectory")
    extended = DynamicGaussians.load(folder)
    trajectory = extend_trajectory(
        as_reconstructed(visible, extended),
        extended,
        given,
        config.trajectory,
        seed=config.seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    trajectory.save(path)
    checkpoint.clear()
    return trajectory


def ensure_camera_split(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> CameraSplit | None:
    """All frames of ``scene``, whose cameras are those that were given, reconstructed from each half of its cameras;
    None if ``config`` does not ask for it. Made once: RUN/camera_split keeps it. Raises InputError for too few
    cameras."""
    from masiv.continuum.camera_split import MIN_CAMERAS, CameraSplit, camera_halves
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.splat.reconstruct import reconstruct

    if not config.refine.camera_split:
        return None
    visible = scene.restricted(holdout_cameras=run.holdout_cameras)
    centre = load_gaussians(run).canonical.means.mean(dim=0).double().numpy()
    halves = camera_halves(visible, centre)
    if halves is None:
        raise InputError(
            f"refine.camera_split: {scene.path} has {len(visible.views)} cameras that are not held out, and two sets "
            f"need {MIN_CAMERAS}: leave it out"
        )
    folders = [run.path / "camera_split" / str(k) for k in range(len(halves))]
    for number, (folder, views) in enumerate(zip(folders, halves, strict=True), 1):
        if folder.is_dir():
            continue
        runtime.start(config.arch)
        others = tuple(view for view in visible.views if view not in views)
        checkpoint = run.checkpoint("camera_split")

        def told(stage: str, done: int, total: int, note: str = "", *, half: int = number) -> None:
            progress(f"{stage}, half {half} of the cameras", done, total, note)

        half = reconstruct(
            visible.restricted(holdout_cameras=others),
            config.reconstruct,
            seed=config.seed,
            checkpoint=checkpoint,
            progress=told,
        )
        with atomic_folder(folder) as temporary:
            half.save(temporary)
        checkpoint.clear()
        scene.release_pictures()
    first, second = (DynamicGaussians.load(folder) for folder in folders)
    return CameraSplit((first, second))


@contextmanager
def material_description(run: RunFolder, config: Config, twin: Twin) -> Iterator[None]:
    """Write material.json, if it is missing, in a second process while the body of this context runs."""
    from masiv.workers import Workers, process_count, unwrap

    if has_material(run):
        yield
        return
    with Workers(min(2, process_count(config.identify.processes)), "identify.processes") as workers:
        wait = workers.submit(describe_material, (run, twin))
        yield
        unwrap(wait())


def has_material(run: RunFolder) -> bool:
    """Whether the run has a material.json; one that is damaged is removed, with a warning."""
    try:
        return read_material(run.path) is not None
    except InputError:
        warnings.warn(f"{run.path / MATERIAL} is damaged: it is made again", stacklevel=3)
        (run.path / MATERIAL).unlink()
        return False


def read_metrics(run: RunFolder) -> dict[str, Any] | None:
    """metrics.json of the run; None if it is missing, or, with a warning, damaged."""
    if not run.metrics.is_file():
        return None
    try:
        return dict(mapping(read_json(run.metrics), str(run.metrics)))
    except InputError:
        warnings.warn(f"{run.metrics} is damaged: it is made again", stacklevel=2)
        return None


def rollout_of(run: RunFolder, twin: Twin, progress: Progress) -> np.ndarray:
    """Positions (T, Q, 3) [m] of the run's rollout.npz; simulated again, with a warning, if the file is damaged, and
    without one if it is missing."""
    from masiv.simulation.simulate import simulate

    if run.rollout.is_file():
        try:
            positions, _ = load_motion(run.rollout)
            if len(positions) == run.frame_count:
                return positions
            reason = f"has {len(positions)} of {run.frame_count} frames"
        except InputError:
            reason = "is damaged"
        warnings.warn(f"{run.rollout} {reason}: the twin is simulated again", stacklevel=2)
    rollout = simulate(twin, frames=run.frame_count, progress=progress)
    rollout.save(run.rollout)
    return rollout.positions


def describe_material(run: RunFolder, twin: Twin, progress: Progress = silent) -> None:
    """Write material.json: the law of ``twin`` in a tester's terms."""
    from masiv.characterization.describe import describe_twin

    if "refined" in twin.fit:  # the numbers of the fit are of the law before: the error is measured
        twin = replace(twin, fit={})
    positions = load_trajectory(run).positions
    describe_twin(twin, frames=run.fit_frames, trajectory=positions, progress=progress).save(run.path / MATERIAL)


def require_run(path: Path, option: str) -> Path:
    """``path`` if it is a run whose identify stage is done. Raises InputError that names ``option``."""
    if not (path / "run.yaml").is_file():
        raise InputError(f"{option} {path} is not a run folder: give one that masiv identify made")
    RunFolder.open(path).require("identify")
    return path
