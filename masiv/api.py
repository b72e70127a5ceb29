"""The library: what the commands do, on objects in memory. ``import masiv`` offers these names.

Every function starts Taichi on ``config.arch`` if it is not running yet. SI units, world frame.

Example:

        scene = masiv.read_scene("assets/sample")
        config = masiv.load_config("quick")
        gaussians = masiv.reconstruct(scene, config)
        scene = masiv.calibrated(scene, gaussians)
        trajectory = masiv.estimate_trajectory(scene, gaussians, config)
        twin = masiv.identify(scene, trajectory, config)
        result, twin = masiv.refine(scene, twin, trajectory, config)
        rollout = masiv.simulate(twin, frames=40, gravity=(0, -1.62, 0))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.config import Config, load_config
from masiv.errors import InputError
from masiv.observations.read import read_observation
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    from masiv.continuum.trajectory import Trajectory
    from masiv.refinement.result import RefineResult
    from masiv.scene.scene import Scene
    from masiv.simulation.force import ForcePulse
    from masiv.simulation.rollout import Rollout
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.tracks.tracks import Tracks
    from masiv.twin import Twin

__all__ = [
    "calibrated",
    "estimate_trajectory",
    "evaluate",
    "identify",
    "load_config",
    "read_scene",
    "reconstruct",
    "refine",
    "simulate",
]


def read_scene(path: str | Path) -> Scene | Tracks:
    """The scene at ``path``, whatever its layout: pictures with cameras, or tracks.

    Pictures are read as they are needed. Raises InputError if no layout is recognised or a file cannot be used; lesser
    problems are in ``problems``.
    """
    return read_observation(path)


def reconstruct(scene: Scene, config: Config | None = None, *, progress: Progress = silent) -> DynamicGaussians:
    """Dynamic Gaussians of the object that ``scene`` shows (paper, section "Dynamic Gaussian reconstruction").

    All frames and cameras of ``scene`` are fitted: use ``scene.restricted`` to hold some out. Cameras are refined with
    them (``config.reconstruct.refine_calibration``): use ``calibrated`` for the scene as later steps should see it.
    Raises InputError if a frame shows no object, MasivError if the fit fails.
    """
    from masiv.splat.reconstruct import reconstruct as stage

    config = _started(config)
    return stage(scene, config.reconstruct, seed=config.seed, checkpoint=Checkpoint(None), progress=progress)


def calibrated(scene: Scene, gaussians: DynamicGaussians) -> Scene:
    """``scene`` as the steps after ``reconstruct`` see it: with the cameras that were refined with ``gaussians``, and,
    if its masks were estimated from colours, with the masks that the Gaussians have."""
    from masiv.splat.rendered_masks import as_reconstructed

    return as_reconstructed(scene, gaussians)


def estimate_trajectory(
    scene: Scene, gaussians: DynamicGaussians, config: Config | None = None, *, progress: Progress = silent
) -> Trajectory:
    """Fill the object with particles and follow them: ``positions`` (T, Q, 3) [m] at ``times`` (T,) [s].

    Cameras and masks are those of ``calibrated``.
    """
    from masiv.continuum.trajectory import estimate_trajectory as stage

    config = _started(config)
    return stage(calibrated(scene, gaussians), gaussians, config.trajectory, seed=config.seed, progress=progress)


def identify(
    scene: Scene | Tracks,
    trajectory: Trajectory | None = None,
    config: Config | None = None,
    *,
    progress: Progress = silent,
) -> Twin:
    """Initial state and constitutive law from the motion of particles or markers, as a ``Twin``.

    ``config.identify.law`` chooses what is fitted: a neural law by default; ``auto``, which tracks take by default, is
    the classical law that explains the motion best. A scene of pictures needs its ``trajectory``. Raises InputError if
    that is missing or the law needs more than tracks show, MasivError if no law explains the motion. A script needs
    ``if __name__ == "__main__":`` if ``config.identify.processes`` is not 1.
    """
    from masiv.tracks.tracks import Tracks

    named = config is not None
    config = _started(config)
    if isinstance(scene, Tracks):
        from masiv.identification.from_tracks import identify_tracks

        law = config.identify.law if named else "auto"
        return identify_tracks(scene, law, config.tracks, config.simulator, progress=progress)[0]
    if trajectory is None:
        raise InputError("a scene of pictures is identified from its trajectory: use estimate_trajectory")
    from masiv.identification.stage import identify as stage

    return stage(scene, trajectory, config.identify, config.simulator, seed=config.seed, progress=progress)


def refine(
    scene: Scene | Tracks,
    twin: Twin,
    trajectory: Trajectory | None = None,
    config: Config | None = None,
    *,
    fit_frames: int | None = None,
    condition: str | None = None,
    dry_run: bool = False,
    progress: Progress = silent,
) -> tuple[RefineResult, Twin]:
    """Find the effects that the model of ``twin`` lacks. Returns what was found, and the twin with accepted effects.

    Pictures: ``trajectory`` covers all frames of ``scene``, of which the first ``fit_frames`` are fitted and the rest
    is held out (the last quarter if None). Tracks: runs with ``use: hold_out`` are held out; ``condition`` chooses runs
    of one body. dry_run: rank the effects, fit none. Raises InputError if nothing is held out or an effect is
    unknown, MasivError if no law explains the motion.
    """
    from masiv.refinement.to_twin import refined_twin
    from masiv.tracks.tracks import Tracks

    config = _started(config)
    if isinstance(scene, Tracks):
        from masiv.refinement.from_tracks import refine_tracks

        result = refine_tracks(
            scene, twin, config.refine, config.tracks, config.simulator, condition=condition, dry_run=dry_run,
            progress=progress,
        )  # fmt: skip
        return result, refined_twin(twin, result)
    if trajectory is None:
        raise InputError("a scene of pictures is refined from its trajectory: use estimate_trajectory")
    from masiv.refinement.from_video import Recording, refine_recordings, split_frames

    frames = split_frames(scene.frame_count, fit_frames or scene.frame_count)
    recording = Recording(twin.initial_conditions[0].observation, scene, trajectory, trajectory, frames)
    start = twin.fit.get("start") or twin.fit.get("law")
    result = refine_recordings(
        [recording], config.identify, config.simulator, config.refine, start=start, dry_run=dry_run, progress=progress
    )
    return result, refined_twin(twin, result)


def simulate(
    twin: Twin,
    *,
    frames: int,
    fps: float | None = None,
    velocity: Sequence[float] | np.ndarray | None = None,
    omega: Sequence[float] | np.ndarray | None = None,
    gravity: Sequence[float] | np.ndarray | None = None,
    force: ForcePulse | None = None,
    without: Sequence[str] = (),
    condition: str | None = None,
    arch: str = "cpu",
    progress: Progress = silent,
) -> Rollout:
    """The first ``frames`` frames of the twin's motion: ``positions`` (frames, Q, 3) float32 [m], and markers of bodies
    that have any.

    velocity (3,) [m/s] of the centroid, omega (3,) [rad/s], gravity (3,) [m/s^2]: as identified if None. force: on the
    whole body for a while. without: names of effects that are left out. condition: of the runs whose start and effects
    are simulated (None: the first). Raises InputError for a vector of another shape, for an effect or a condition that
    the twin does not have and for what its bodies cannot have; NonFiniteError if the motion diverges.
    """
    from masiv.simulation.simulate import simulate as stage

    runtime.start(arch)
    return stage(
        twin,
        frames=frames,
        fps=fps,
        velocity=_vector("velocity", velocity),
        omega=_vector("omega", omega),
        gravity=_vector("gravity", gravity),
        force=force,
        without=tuple(without),
        condition=condition,
        progress=progress,
    )


def evaluate(
    positions: np.ndarray, truth: np.ndarray | str | Path, frames: Sequence[int] | None = None
) -> dict[str, Any]:
    """Chamfer distance [10^3 mm^2] and tracked error [mm] of ``positions`` (T, Q, 3) [m] against true particles.

    truth: (T, P, 3) [m], or a folder with particles_F.npy (P, 3). frames: those compared (all if None).
    Raises InputError if the shapes do not agree.
    """
    from masiv.report.measure import motion_numbers, read_truth

    moved = np.asarray(positions)
    if moved.ndim != 3 or moved.shape[2] != 3:
        raise InputError(f"positions have shape {moved.shape}: give (T, Q, 3)")
    true = np.asarray(truth) if isinstance(truth, np.ndarray) else read_truth(Path(truth), len(moved))
    if true.ndim != 3 or true.shape[2] != 3:
        raise InputError(f"the truth has shape {true.shape}: give (T, P, 3)")
    chosen = list(range(min(len(moved), len(true)))) if frames is None else list(frames)
    numbers = motion_numbers(moved, true, chosen)
    if numbers is None:
        raise InputError("nothing to compare: positions and truth share no frame")
    return numbers


def _started(config: Config | None) -> Config:
    config = config or load_config()
    runtime.start(config.arch)
    return config


def _vector(name: str, value: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    if value is None:
        return None
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"{name} must be three finite numbers, not {value}")
    return array
