"""Results of a run, or of ``masiv simulate``, in the formats of other programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv import runtime
from masiv.errors import InputError
from masiv.files import read_npz
from masiv.pipeline.requests import Summary
from masiv.pipeline.stages import load_gaussians
from masiv.progress import Progress, silent
from masiv.report.sections.material import MATERIAL, read_material
from masiv.runfolder import RunFolder, load_motion, refuse_run

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


@dataclass(frozen=True)
class Format:
    """A format. what: it holds. extension: of its file; empty for a folder. write: (source, path, progress) -> lines to
    print."""

    what: str
    extension: str
    write: Callable[[Source, Path, Progress], list[str]]


def _vtkhdf(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_vtkhdf

    write_vtkhdf(_motion(source, progress), path, progress=progress)
    return []


def _ply(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_ply_sequence

    write_ply_sequence(_motion(source, progress), path, progress=progress)
    return []


def _obj(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_obj_sequence

    write_obj_sequence(_deforming(source, progress), path, progress=progress)
    return []


def _glb(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_glb

    write_glb(_deforming(source, progress), path, up=source.up(), progress=progress)
    return []


def _usd(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_usd

    write_usd(_deforming(source, progress), path, up=source.up(), progress=progress)
    return []


def _gaussians(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_gaussians

    write_gaussians(_moving_gaussians(source, progress), path)
    return []


def _law(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_law_csv
    from masiv.export.law import MAX_STEP, MIN_STEPS, RATE, STRAIN

    twin = _deformable_twin(source, "law")
    material = source.material()
    if material is None or not material.get("excited"):
        write_law_csv(twin.law, path)
        return [f"strains up to {STRAIN:g} at {RATE:g}/s"]
    from masiv.characterization.describe import MAX_TEST_STRAIN, MIN_TEST_STRAIN

    excited = material["excited"]
    strain = float(np.clip(excited["strain"][1], MIN_TEST_STRAIN, MAX_TEST_STRAIN))
    rate = max(excited["rate"], strain / (MIN_STEPS * MAX_STEP))
    write_law_csv(twin.law, path, strain=strain, rate=rate)
    return [f"strains up to {strain:.3g}, as observed, at {rate:.3g}/s"]


def _newton(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_newton_scene

    notes = write_newton_scene(_deformable_twin(source, "scene for Newton"), path, material=source.material())
    return ["differences to the twin:", *(f"  {note}" for note in notes)]


FORMATS = {
    "vtkhdf": Format("particles", ".vtkhdf", _vtkhdf),
    "ply": Format("particles", "", _ply),
    "obj": Format("surface", "", _obj),
    "glb": Format("surface", ".glb", _glb),
    "usd": Format("particles and surface", ".usdc", _usd),
    "3dgs": Format("Gaussians", "", _gaussians),
    "csv": Format("law", ".csv", _law),
    "newton": Format("twin", "", _newton),
}


def export_results(
    folder: Path,
    kind: str,
    out: Path | None = None,
    *,
    run: Path | None = None,
    motion: str = "rollout",
    arch: str = "cpu",
    progress: Progress = silent,
) -> Summary:
    """Write results of ``folder``, a run or the output of ``masiv simulate``, in the format ``kind`` of ``FORMATS``.

    out: a file or a folder (None: named after ``folder``, in the current one). run: of which ``folder`` is a
    simulation. motion: "rollout" of the twin, or the "trajectory" that was observed. Raises InputError if the format
    or the folder is unknown, ``out`` cannot be written, or the format does not exist for what ``folder`` holds.
    """
    if kind not in FORMATS:
        raise InputError(f"--format {kind}: give one of {', '.join(FORMATS)}")
    if motion not in MOTIONS:
        raise InputError(f"--motion {motion}: give one of {', '.join(MOTIONS)}")
    source = _source(folder, run, motion, arch)
    chosen = FORMATS[kind]
    path = out or Path(f"{folder.resolve().name}_{kind}{chosen.extension}")
    refuse_run(path, "--out")
    if chosen.extension and path.is_dir():
        raise InputError(f"--out {path} is a folder: give the name of a file")
    lines = chosen.write(source, path, progress)
    data = {"path": str(path), "format": kind, "what": chosen.what, "motion": motion, "notes": lines}
    return Summary(data, "\n".join([str(path), *lines]))


def _source(folder: Path, run: Path | None, motion: str, arch: str) -> Source:
    if (folder / "run.yaml").is_file():
        if run is not None:
            raise InputError(f"--run {run}: {folder} is a run itself, leave it out")
        return Source(folder, RunFolder.open(folder), motion, arch)
    if not (folder / "rollout.npz").is_file():
        raise InputError(f"{folder} is neither a run folder nor a folder that masiv simulate wrote")
    if motion == "trajectory":
        raise InputError(f"{folder} holds a simulation, which has no trajectory: leave out --motion")
    return Source(folder, None if run is None else RunFolder.open(run), motion, arch)


def _motion(source: Source, progress: Progress) -> Rollout:
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


def _deforming(source: Source, progress: Progress) -> Rollout:
    """``_motion`` of a body that has a surface. Raises InputError for rigid bodies, which are points."""
    if source.is_run and source.motion == "rollout":
        _deformable_twin(source, "surface")
    return _motion(source, progress)


def _deformable_twin(source: Source, what: str) -> Twin:
    twin = source.twin()
    if twin.rigid:
        raise InputError(f"the bodies of {source.folder} are rigid, and a rigid body is a point: there is no {what}")
    return twin


def _moving_gaussians(source: Source, progress: Progress) -> Iterable[Gaussians]:
    from masiv.export import follow_gaussians

    run = source.the_run("Gaussians")
    if run.record["scene"].get("layout") == "tracks":
        raise InputError(f"{run.path} is a run of tracks: without pictures there are no Gaussians")
    dynamic = load_gaussians(run)
    if source.motion == "trajectory":
        times = load_motion(run.trajectory)[1]
        return (dynamic.at(float(time)) for time in times)
    return follow_gaussians(dynamic.at(0.0), _motion(source, progress).positions)
