"""The stages of a batch and what they wait for. Light: no torch, no taichi."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from masiv.batch.spec import BatchSpec, Job, RefineOptions

RUNS, SHARED = "runs", "shared"


@dataclass(frozen=True)
class Stage:
    """A command of masiv on one run folder.

    key: unique name; run: of the job, or of what several jobs share; command: its arguments; after: keys of stages that
    must be done before; copy_of: a run folder that ``folder`` begins as, if it does not exist.
    """

    key: str
    run: str
    name: str
    folder: Path
    command: tuple[str, ...]
    after: tuple[str, ...] = ()
    copy_of: Path | None = None


def stages_of(spec: BatchSpec, jobs: Sequence[Job], out: Path, arch: str | None = None) -> tuple[Stage, ...]:
    """All stages, each after those that it waits for. Jobs that differ in the law alone, or in settings of the law,
    share reconstruction and trajectory. arch: of all runs, as --arch."""
    sharing = Counter(_shared_name(job, jobs) for job in jobs if job.pictures)
    stages: dict[str, Stage] = {}
    for job in jobs:
        own = out / RUNS / job.name
        before: list[Stage] = []
        if job.pictures:
            shared = _shared_name(job, jobs)
            alone = sharing[shared] == 1
            run, base = (job.name, own) if alone else (f"{SHARED}/{shared}", out / SHARED / shared)
            before = _before_laws(spec, job, run, base, job.settings if alone else job.before_laws, arch)
        chain = [*before, *_with_law(spec, job, own, before, arch)]
        stages |= {stage.key: stage for stage in chain if stage.key not in stages}
    return tuple(stages.values())


def _before_laws(
    spec: BatchSpec, job: Job, run: str, base: Path, settings: Sequence[str], arch: str | None
) -> list[Stage]:
    """Reconstruction and trajectory of ``job`` in the folder ``base``."""
    options = (*_options(spec, job.seed, settings, arch), *_picture_options(spec))
    reconstruct = Stage(
        f"{run}/reconstruct", run, "reconstruct", base, ("reconstruct", str(job.scene), "--out", str(base), *options)
    )
    return [
        reconstruct,
        Stage(f"{run}/trajectory", run, "trajectory", base, ("trajectory", str(base)), (reconstruct.key,)),
    ]


def _with_law(spec: BatchSpec, job: Job, own: Path, before: Sequence[Stage], arch: str | None) -> list[Stage]:
    """The stages of ``job`` in its own folder that follow on ``before``."""
    on = () if arch is None else ("--arch", arch)
    commands: list[tuple[str, tuple[str, ...]]] = []
    law = () if job.law is None else ("--law", job.law)
    pictures = _picture_options(spec) if job.pictures else ()
    commands.append(
        (
            "identify",
            (str(job.scene), "--out", str(own), *_options(spec, job.seed, job.settings, arch), *pictures, *law),
        )
    )
    if spec.refine:
        asked = spec.refine if isinstance(spec.refine, RefineOptions) else RefineOptions()
        group = ("--group",) if asked.group else ()
        condition = () if asked.condition is None else ("--condition", asked.condition)
        commands.append(("refine", (str(own), *group, *condition, *on)))
    truth = job.scene / "gt"
    if spec.evaluate and (not job.pictures or truth.is_dir()):
        commands.append(("evaluate", (str(own), *(("--truth", str(truth)) if job.pictures else ()), *on)))
    stages: list[Stage] = []
    base = before[-1].folder if before and before[-1].folder != own else None
    for name, arguments in commands:
        after = tuple(stage.key for stage in (stages or before)[-1:])
        stages.append(
            Stage(f"{job.name}/{name}", job.name, name, own, (name, *arguments), after, None if stages else base)
        )
    return stages


def _shared_name(job: Job, jobs: Sequence[Job]) -> str:
    """The name of the first job with the same scene, seed and settings of reconstruction and trajectory."""
    return next(
        other.name for other in jobs
        if other.pictures and (other.scene, other.seed, other.before_laws) == (job.scene, job.seed, job.before_laws)
    )  # fmt: skip


def _options(spec: BatchSpec, seed: int, settings: Sequence[str], arch: str | None) -> tuple[str, ...]:
    out: tuple[str, ...] = ("--seed", str(seed))
    out += () if spec.preset is None else ("--preset", spec.preset)
    out += () if arch is None else ("--arch", arch)
    for setting in settings:
        out += ("--set", setting)
    return out


def _picture_options(spec: BatchSpec) -> tuple[str, ...]:
    out: tuple[str, ...] = () if spec.fit_frames is None else ("--fit-frames", str(spec.fit_frames))
    for camera in spec.holdout_camera:
        out += ("--holdout-camera", str(camera))
    return out + (("--keep-calibration",) if spec.keep_calibration else ())
