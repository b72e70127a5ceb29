"""The stages in order, each run where the run folder lacks it. What several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from masiv import runtime
from masiv.config import Config, load_config
from masiv.errors import InputError
from masiv.observations.read import read_scene
from masiv.progress import Progress, silent
from masiv.report.history import logged
from masiv.report.material import MATERIAL
from masiv.runfolder import Request, RunFolder
from masiv.scene.scene import Scene
from masiv.scene.summary import identity

if TYPE_CHECKING:
    import numpy as np

    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.splat.gaussians import Gaussians
    from masiv.twin import Twin


def open_run(
    scene_path: Path,
    out: Path,
    *,
    preset: str | None = None,
    config: Path | None = None,
    seed: int | None = None,
    arch: str | None = None,
    fit_frames: int | None = None,
    holdout: list[int] | None = None,
    **identify: str | float | list[str] | None,
) -> tuple[RunFolder, Config, Scene]:
    """The run in ``out``, new or resumed, its configuration and the whole scene. What is not given is as in the run.

    identify: keys of that section of the configuration.
    Everything is checked before the folder is made. Raises InputError.
    """
    existing = RunFolder.open(out) if (out / "run.yaml").is_file() else None
    flags: dict[str, int | float | str | list[str] | None] = {"seed": seed, "arch": arch}
    flags |= {f"identify.{key}": value for key, value in identify.items()}
    settings = load_config(preset, config, existing.config if existing else None, **flags)
    scene = read_scene(scene_path)
    for other in settings.identify.also:
        settings.identify.refuse_more_throws()
        if Path(other).resolve() == out.resolve():
            raise InputError(f"--also {other} is the run itself: give those of other throws of the same object")
        RunFolder.open(Path(other)).require("trajectory")
    if fit_frames is None:
        fit_frames = existing.fit_frames if existing else scene.fit_frames or scene.frame_count
    cameras = tuple(sorted(set(holdout))) if holdout else existing.holdout_cameras if existing else ()
    scene.restricted(fit_frames, cameras)
    request = Request(settings.model_dump(mode="json"), scene_path, identity(scene), fit_frames, cameras)
    return RunFolder.create_or_resume(out, request), settings, scene


def reopen_run(
    run_path: Path, *, preset: str | None, config: Path | None, seed: int | None, arch: str | None
) -> tuple[RunFolder, Config, Scene]:
    """An existing run, with the scene that it was made of."""
    existing = RunFolder.open(run_path)
    return open_run(existing.scene_path, run_path, preset=preset, config=config, seed=seed, arch=arch)


def fitted_scene(run: RunFolder, scene: Scene) -> Scene:
    """What a stage that fits may see."""
    return scene.restricted(run.fit_frames, run.holdout_cameras)


def reconstructed(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> DynamicGaussians:
    """The run's dynamic Gaussians, made now where it lacks them."""
    runtime.start(config.arch)
    if run.done("reconstruct"):
        return load_dynamic(run)
    from masiv.splat.reconstruct import reconstruct

    with run.stage("reconstruct") as checkpoint:
        dynamic = reconstruct(
            fitted_scene(run, scene),
            config.reconstruct,
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        dynamic.save(run.path)
    return dynamic


def estimated(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Trajectory:
    """The run's trajectory, made now where it lacks it."""
    runtime.start(config.arch)
    if run.done("trajectory"):
        return load_trajectory(run)
    from masiv.continuum.trajectory import estimate_trajectory

    dynamic = reconstructed(run, config, scene, progress)
    with run.stage("trajectory") as checkpoint:
        trajectory = estimate_trajectory(
            fitted_scene(run, scene),
            dynamic,
            config.trajectory,
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        trajectory.save(run.trajectory)
    return trajectory


def other_throws(config: Config) -> list[tuple[Scene, Trajectory]]:
    """The other throws from which the law is learnt, as far as their runs may be fitted."""
    runs = [RunFolder.open(Path(path)) for path in config.identify.also]
    return [(fitted_scene(run, read_scene(run.scene_path)), load_trajectory(run)) for run in runs]


def held_out_trajectory(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Trajectory | None:
    """The run's particles through all frames of ``scene``: those that the run held out are measured here, after every
    fit and by none of them. None where no frame was held out.

    Frames before ``run.fit_frames`` are those of the run. Made once: RUN/held_out keeps it. Raises InputError where the
    run has no trajectory yet.
    """
    if run.fit_frames >= scene.frame_count:
        return None
    from masiv.continuum.extend_trajectory import extend_trajectory
    from masiv.continuum.trajectory import Trajectory
    from masiv.splat.dynamic import DynamicGaussians
    from masiv.splat.extend_frames import ExtendFramesConfig, extend_frames

    folder = run.path / "held_out"
    path = folder / "trajectory.npz"
    if path.is_file():
        return Trajectory.load(path)
    runtime.start(config.arch)
    given = load_trajectory(run)
    seen = scene.restricted(holdout_cameras=run.holdout_cameras)
    folder.mkdir(exist_ok=True)
    checkpoint = run.checkpoint("held_out_gaussians")
    if not (folder / "deformation.safetensors").is_file():
        extended = extend_frames(
            seen,
            load_dynamic(run),
            config.reconstruct,
            ExtendFramesConfig.model_validate({}),
            seed=config.seed,
            checkpoint=checkpoint,
            progress=progress,
        )
        extended.save(folder)
    checkpoint.clear()
    checkpoint = run.checkpoint("held_out_trajectory")
    trajectory = extend_trajectory(
        seen,
        DynamicGaussians.load(folder),
        given,
        config.trajectory,
        seed=config.seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    trajectory.save(path)
    checkpoint.clear()
    return trajectory


def identified(run: RunFolder, config: Config, scene: Scene, progress: Progress) -> Twin:
    """The run's twin, made now where it lacks it."""
    runtime.start(config.arch)
    from masiv.identify.stage import identify
    from masiv.twin import Twin

    if run.done("identify"):
        return Twin.load(run.path)
    trajectory = estimated(run, config, scene, progress)
    with run.stage("identify") as checkpoint:
        twin = identify(
            fitted_scene(run, scene),
            trajectory,
            config.identify,
            config.simulator,
            others=other_throws(config),
            seed=config.seed,
            checkpoint=checkpoint,
            progress=logged(progress, run.log),
        )
        (run.path / MATERIAL).unlink(missing_ok=True)  # of an earlier twin
        twin.save(run.path)
    return twin


@contextmanager
def described(run: RunFolder, config: Config, twin: Twin) -> Iterator[None]:
    """Beside what the body of this context does, in a process of its own, material.json is made where it lacks."""
    from masiv.workers import Workers, process_count, unwrap

    if (run.path / MATERIAL).is_file():
        yield
        return
    with Workers(min(2, process_count(config.identify.processes)), "identify.processes") as workers:
        found = workers.submit(describe, (run, twin))
        yield
        unwrap(found())


def describe(run: RunFolder, twin: Twin, progress: Progress = silent) -> None:
    """Write material.json: what the law of ``twin`` is in a tester's terms."""
    from masiv.materials.describe import describe_twin

    if "refined" in twin.fit:  # what else is known of a fit is of the law before: the error is measured
        twin = replace(twin, fit={})
    positions = load_trajectory(run).positions
    describe_twin(twin, frames=run.fit_frames, trajectory=positions, progress=progress).save(run.path / MATERIAL)


def varied(
    run: RunFolder,
    *,
    law: Path | None = None,
    blend: float | None = None,
    geometry: Path | None = None,
    density: float | None = None,
    ground: str | None = None,
) -> tuple[Twin, Callable[[], Gaussians]]:
    """The run's twin with another law, body, density or ground, and what gives the Gaussians to draw it with.

    Raises InputError for a run or a mesh that is not there or cannot be used.
    """
    from masiv.materials.blend import blend as between
    from masiv.simulation import variation
    from masiv.twin import Twin

    twin = Twin.load(run.path)
    if law is not None:
        other = Twin.load(_other(law, "--law"))
        twin = replace(twin, law=between(twin.law, other.law, 1.0 if blend is None else blend))
    if density is not None:
        twin = variation.with_density(twin, density)
    if geometry is None:
        return _over(twin, ground), lambda: load_dynamic(run).at(0.0)
    if geometry.is_dir():
        source = RunFolder.open(_other(geometry, "--geometry"))
        twin, shift = variation.with_body_of(twin, Twin.load(source.path))
        return _over(twin, ground), lambda: _moved(load_dynamic(source).at(0.0), shift)
    if not geometry.is_file():
        raise InputError(f"--geometry {geometry} does not exist: give a mesh file or another run's folder")
    twin = variation.with_mesh(twin, geometry)

    def look() -> Gaussians:
        from masiv.report.film import balls

        return balls(twin.positions, twin.volume)

    return _over(twin, ground), look


def _other(path: Path, flag: str) -> Path:
    """``path`` where it is a run whose identify stage is done. Raises InputError."""
    if not (path / "run.yaml").is_file():
        raise InputError(f"{flag} {path} is not a run folder: give one that masiv identify made")
    RunFolder.open(path).require("identify")
    return path


def _over(twin: Twin, ground: str | None) -> Twin:
    from masiv.simulation.variation import with_ground

    return twin if ground is None else with_ground(twin, ground)


def _moved(gaussians: Gaussians, shift: np.ndarray) -> Gaussians:
    import torch

    return replace(gaussians, means=gaussians.means + torch.as_tensor(shift).to(gaussians.means))


def start(config: Config) -> None:
    """Start Taichi where the configuration says."""
    runtime.start(config.arch)


def load_dynamic(run: RunFolder) -> DynamicGaussians:
    """The Gaussians of a finished reconstruct stage. Raises InputError."""
    from masiv.splat.dynamic import DynamicGaussians

    run.require("reconstruct")
    return DynamicGaussians.load(run.path)


def load_trajectory(run: RunFolder) -> Trajectory:
    """The result of a finished trajectory stage. Raises InputError."""
    from masiv.continuum.trajectory import Trajectory

    run.require("trajectory")
    return Trajectory.load(run.trajectory)
