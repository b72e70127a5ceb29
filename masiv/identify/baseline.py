"""Identify with a classical law: one that is named, the best of all, or one with a learnt correction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify.classical_fit import (
    FamilyFit,
    fit_all_particles,
    fit_family,
    fit_further,
    information_criteria,
    keep,
    ranked,
)
from masiv.identify.fit import fit as fit_weights
from masiv.identify.found import Found, history_rows
from masiv.identify.judged import nearest_first, picture_errors_of
from masiv.identify.polish import wanted
from masiv.identify.problem import Problem
from masiv.identify.throw import Throw
from masiv.materials.adapter import AdapterLaw
from masiv.models.families import FAMILIES
from masiv.models.initial_state import InitialState
from masiv.progress import Progress, silent
from masiv.workers import TaskError, Workers, processes_wanted

SHORT = 1 / 3
FINALISTS = 2
BY_PICTURES = "nearest to the pictures, the simpler one where two are about as near"


def identify_classical(
    problem: Problem,
    coarse: Problem,
    motion: InitialState,
    first_frames: int,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Found:
    """``problem.config.law`` is a family, auto or adapter. Raises MasivError where no family explains the motion."""
    config = problem.config
    law = config.adapter_base if config.law == "adapter" else config.law
    pictures = wanted(problem)
    failures: dict[str, str] = {}
    if law == "auto":
        with Workers(processes_wanted(config.processes), "identify.processes") as workers:
            fits, failures = _shortlisted(coarse, motion, first_frames, pictures, checkpoint, progress, workers)
    else:
        fits = [fit_family(law, coarse, motion, first_frames, checkpoint, progress, pictures=pictures)]
    seen = picture_errors_of(coarse, fits) if law == "auto" else {}
    order = nearest_first(fits, seen)
    chosen = fit_all_particles(order[0], coarse, problem, checkpoint, progress, pictures=pictures)
    errors = {name: _known(chosen.stderr[name]) for name in chosen.values if name not in chosen.law.values}
    report: dict[str, Any] = {
        "law": chosen.kind,
        "chosen_by": "asked for" if law != "auto" else BY_PICTURES if seen else "least Bayesian information criterion",
        "velocity_stderr_m_per_s": [errors[f"velocity_{a}"] for a in "xyz"],
        "omega_stderr_rad_per_s": [errors[f"omega_{a}"] for a in "xyz"],
        "ground_stderr_m": errors.get("ground_offset"),
        "independent_samples": chosen.samples,
        "rollouts": chosen.rollouts + sum(f.rollouts for f in fits if f.kind != chosen.kind),
    }
    if law == "auto":
        report["families"] = [
            *family_rows(order, seen),
            *({"law": kind, "failed": why} for kind, why in failures.items()),
        ]
    if config.law != "adapter":
        return Found(chosen.law, chosen.motion, chosen.contact, chosen.error_m, report)
    start = AdapterLaw(chosen.law, rank=config.adapter_rank, seed=seed).float()
    start.base.double()
    learnt_from = problem.of_surfaces(config.iterations) if pictures else problem  # paths led the classical law
    fitted = fit_weights(
        [Throw(learnt_from, chosen.motion, problem.frames)],  # the classical law was fitted to all frames
        start, chosen.contact, seed=seed, checkpoint=Beside(checkpoint), progress=progress,
    )  # fmt: skip
    report["classical_error_mm"] = 1e3 * chosen.error_m
    return Found(fitted.law, fitted.motions[0], chosen.contact, fitted.error_m, report, history_rows(fitted))


class Beside(Checkpoint):
    """A checkpoint whose states are saved beside what it held when it was made."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__(checkpoint.path, checkpoint.every_s)
        self.fixed = self.load() or {}

    def save(self, state: dict[str, Any]) -> None:
        super().save({**self.fixed, **state})


def _shortlisted(
    coarse: Problem, motion: InitialState, first_frames: int, pictures: bool,
    checkpoint: Checkpoint, progress: Progress, workers: Workers,
) -> tuple[list[FamilyFit], dict[str, str]]:  # fmt: skip
    """Short fits of every family, then in full the best ``FINALISTS`` by their paths and the best by the pictures
    (which tell little of a fit that is far from its end); and why the others failed."""
    saved = checkpoint.load() or {}
    fits = {kind: FamilyFit(**saved[kind]) for kind in FAMILIES if kind in saved}
    failures: dict[str, str] = {}
    heard = progress if workers.processes == 1 else silent

    def done(kinds: Sequence[str], found: Iterable[FamilyFit | TaskError], label: str) -> None:
        progress(label, 0, len(kinds), ", ".join(kinds))
        for k, (kind, fit) in enumerate(zip(kinds, found, strict=True)):
            if isinstance(fit, TaskError):
                failures[kind] = fit.reason
                note = f"{kind}: {fit.reason}"
            else:
                fits[kind] = fit
                keep(checkpoint, fit)
                note = f"{kind}: {1e3 * fit.error_m:.1f} mm"
            progress(label, k + 1, len(kinds), note)

    missing = [kind for kind in FAMILIES if kind not in fits]
    tasks = [(kind, coarse, motion, first_frames, pictures, heard) for kind in missing]
    done(missing, workers.map(_short_fit, tasks), "identify: classical laws, in short")
    if not fits:
        raise MasivError(f"identify: no classical law explains the motion ({next(iter(failures.values()))})")
    if "finalists" not in saved:  # a fit that went on is no short one any more
        short = list(fits.values())
        best = [*ranked(short)[:FINALISTS], nearest_first(short, picture_errors_of(coarse, short))[0]]
        saved = {**(checkpoint.load() or {}), "finalists": list(dict.fromkeys(f.kind for f in best))}
        checkpoint.save(saved)
    kinds = saved["finalists"]
    tasks = [(fits[kind], coarse, pictures, heard) for kind in kinds]
    done(kinds, workers.map(_further_fit, tasks), "identify: classical laws, the best")
    return list(fits.values()), failures


def _short_fit(
    kind: str, coarse: Problem, motion: InitialState, first_frames: int, pictures: bool, progress: Progress
) -> FamilyFit:
    return fit_family(
        kind, coarse, motion, first_frames, Checkpoint(None), progress, share=SHORT, pictures=pictures
    )  # fmt: skip


def _further_fit(found: FamilyFit, coarse: Problem, pictures: bool, progress: Progress) -> FamilyFit:
    return fit_further(found, coarse, progress, pictures=pictures)


def family_rows(order: list[FamilyFit], pictures: Mapping[str, float]) -> list[dict[str, Any]]:
    """Errors and parameters of each family, best first, as fitted on few particles, those that lag in short. pictures:
    errors of those, empty where there are no pictures."""
    criteria = information_criteria(order)
    return [
        {
            "law": f.kind,
            "trajectory_error_mm": 1e3 * f.error_m,
            "picture_error": pictures.get(f.kind),
            "bic_above_best": criteria[f.kind] - min(criteria.values()),
            "contact": f.contact,
            "parameters": f.law.description()["parameters"],
        }
        for f in order
    ]


def _known(error: float) -> float | None:
    return error if math.isfinite(error) else None
