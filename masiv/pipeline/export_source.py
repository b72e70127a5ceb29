"""What is exported: a run, or the output of ``masiv simulate``, and its motion."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv import runtime
from masiv.errors import InputError
from masiv.files import read_npz
from masiv.pipeline.stages import load_gaussians
from masiv.progress import Progress
from masiv.report.sections.material import MATERIAL, read_material
from masiv.runfolder import RunFolder, load_motion

if TYPE_CHECKING:
    from masiv.simulation.rollout import Rollout
    from masiv.splat.gaussians import Gaussians
    from masiv.twin import Twin

MOTIONS = ("rollout", "trajectory")


@dataclass(frozen=True)
class Source:
    """What is exported. folder: a run, or what ``masiv simulate`` wrote. run: the run itself, or the one that the
    simulation was made from, if it is known. motion: see ``MOTIONS``. arch: Taichi's backend, if it is needed."""

    folder: Path
    run: RunFolder | None
    motion: str
    arch: str = "cpu"

    @property
    def is_run(self) -> bool:
        return self.run is not None and self.run.path == self.folder

    def the_run(self, what: str) -> RunFolder:
        """The run, for ``what`` a simulation does not hold. Raises InputError if it is not known."""
        if self.run is None:
            raise InputError(
                f"{self.folder} holds a simulation and no {what}: say which run it was made from with --run"
            )
        return self.run

    def twin(self) -> Twin:
        """Of the run. Raises InputError."""
        from masiv.twin import Twin

        run = self.the_run("twin")
        run.require("identify")
        return Twin.load(run.path)

    def up(self) -> np.ndarray:
        """(3,) of the world; +y if no run is known."""
        return np.array([0.0, 1.0, 0.0]) if self.run is None else np.array(self.twin().up)

    def material(self) -> dict[str, Any] | None:
        """material.json of the run, if it has one. Raises InputError if ``excited`` or ``quantities`` in it are not
        what masiv writes."""
        material = None if self.run is None else read_material(self.run.path)
        if material is not None:
            try:
                excited = material.get("excited") or {"strain": [0.0, 1.0], "rate": 1.0}
                rows = (material.get("quantities") or {}).values()
                numbers = [excited["strain"][1], excited["rate"], *(row["value"] for row in rows)]
                if not all(number is None or math.isfinite(number) for number in numbers):
                    raise ValueError("a number is not finite")
            except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
                assert self.run is not None
                where = self.run.path / MATERIAL
                raise InputError(f"{where} is damaged ({error}): delete it and run masiv identify again") from error
        return material


def open_source(folder: Path, run: Path | None, motion: str, arch: str) -> Source:
    """The source at ``folder``. Raises InputError if it is none, or does not go with the options."""
    if (folder / "run.yaml").is_file():
        if run is not None:
            raise InputError(f"--run {run}: {folder} is a run itself, leave it out")
        return Source(folder, RunFolder.open(folder), motion, arch)
    if not (folder / "rollout.npz").is_file():
        raise InputError(f"{folder} is neither a run folder nor a folder that masiv simulate wrote")
    if motion == "trajectory":
        raise InputError(f"{folder} holds a simulation, which has no trajectory: leave out --motion")
    return Source(folder, None if run is None else RunFolder.open(run), motion, arch)


def motion_of(source: Source, progress: Progress) -> Rollout:
    """Positions of particles over time; a run of tracks, whose rollout holds markers, is simulated."""
    from masiv.simulation.rollout import Rollout

    run = source.run if source.is_run else None
    if run is None:
        return Rollout(*load_motion(source.folder / "rollout.npz"))
    tracks = run.record["scene"].get("layout") == "tracks"
    if source.motion == "trajectory":
        if tracks:
            raise InputError(f"{run.path} is a run of tracks, whose markers are its observation: it has no trajectory")
        run.require("trajectory")
        return Rollout(*load_motion(run.trajectory))
    run.require("identify")
    if not tracks:
        return Rollout(*load_motion(run.rollout))
    from masiv.simulation.simulate import simulate

    twin = source.twin().in_condition()
    name = twin.initial_conditions[0].observation
    times = read_npz(run.rollout).get(f"times@{name}")
    if times is None:
        raise InputError(f"{run.rollout} has no times of {name}: run masiv identify again")
    runtime.start(source.arch)
    return simulate(twin, frames=len(times), progress=progress)


def deforming_motion(source: Source, progress: Progress) -> Rollout:
    """``motion_of`` of a body that has a surface. Raises InputError for rigid bodies, which are points."""
    if source.is_run and source.motion == "rollout":
        deformable_twin(source, "surface")
    return motion_of(source, progress)


def deformable_twin(source: Source, what: str) -> Twin:
    """The twin of the run. Raises InputError if its bodies are rigid: these have no ``what``."""
    twin = source.twin()
    if twin.rigid:
        raise InputError(f"the bodies of {source.folder} are rigid, and a rigid body is a point: there is no {what}")
    return twin


def moving_gaussians(source: Source, progress: Progress) -> Iterable[Gaussians]:
    """Gaussians of each frame. Raises InputError if the run has none, or is not known."""
    from masiv.export import follow_gaussians

    run = source.the_run("Gaussians")
    if run.record["scene"].get("layout") == "tracks":
        raise InputError(f"{run.path} is a run of tracks: without pictures there are no Gaussians")
    dynamic = load_gaussians(run)
    if source.motion == "trajectory":
        times = load_motion(run.trajectory)[1]
        return (dynamic.at(float(time)) for time in times)
    return follow_gaussians(dynamic.at(0.0), motion_of(source, progress).positions)
