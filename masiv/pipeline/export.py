"""Results of a run, or of ``masiv simulate``, in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.pipeline.export_source import (
    MOTIONS,
    Source,
    deformable_twin,
    deforming_motion,
    motion_of,
    moving_gaussians,
    open_source,
)
from masiv.pipeline.requests import Summary
from masiv.progress import Progress, silent
from masiv.runfolder import refuse_run


@dataclass(frozen=True)
class Format:
    """A format. what: it holds. extension: of its file; empty for a folder. write: (source, path, progress) -> lines to
    print."""

    what: str
    extension: str
    write: Callable[[Source, Path, Progress], list[str]]


def _vtkhdf(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_vtkhdf

    write_vtkhdf(motion_of(source, progress), path, progress=progress)
    return []


def _ply(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_ply_sequence

    write_ply_sequence(motion_of(source, progress), path, progress=progress)
    return []


def _obj(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_obj_sequence

    write_obj_sequence(deforming_motion(source, progress), path, progress=progress)
    return []


def _glb(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_glb

    write_glb(deforming_motion(source, progress), path, up=source.up(), progress=progress)
    return []


def _usd(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_usd

    write_usd(deforming_motion(source, progress), path, up=source.up(), progress=progress)
    return []


def _gaussians(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_gaussians

    write_gaussians(moving_gaussians(source, progress), path)
    return []


def _law(source: Source, path: Path, progress: Progress) -> list[str]:
    from masiv.export import write_law_csv
    from masiv.export.law import MAX_STEP, MIN_STEPS, RATE, STRAIN

    twin = deformable_twin(source, "law")
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

    notes = write_newton_scene(deformable_twin(source, "scene for Newton"), path, material=source.material())
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
    source = open_source(folder, run, motion, arch)
    chosen = FORMATS[kind]
    path = out or Path(f"{folder.resolve().name}_{kind}{chosen.extension}")
    refuse_run(path, "--out")
    if chosen.extension and path.is_dir():
        raise InputError(f"--out {path} is a folder: give the name of a file")
    lines = chosen.write(source, path, progress)
    data = {"path": str(path), "format": kind, "what": chosen.what, "motion": motion, "notes": lines}
    return Summary(data, "\n".join([str(path), *lines]))
