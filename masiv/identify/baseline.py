"""Identify with a classical law: one that is named, the best of all, or one with a learnt correction."""

from __future__ import annotations

import math
from typing import Any

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify.classical_fit import (
    FamilyFit,
    best_family,
    fit_all_particles,
    fit_family,
    information_criterion,
)
from masiv.identify.families import FAMILIES
from masiv.identify.found import Found
from masiv.identify.problem import Motion, Problem
from masiv.progress import Progress


def identify_classical(
    problem: Problem, few: Problem, motion: Motion, first_frames: int, checkpoint: Checkpoint, progress: Progress
) -> Found:
    """``problem.config.law`` is a family or auto. Raises MasivError where no family explains the motion."""
    law = problem.config.law
    kinds = list(FAMILIES) if law == "auto" else [law]
    fits, failures = _fits(kinds, few, motion, first_frames, checkpoint, progress)
    chosen = fit_all_particles(best_family(fits), few, problem, checkpoint, progress)
    errors = {name: _known(chosen.stderr[name]) for name in chosen.values if name not in chosen.law.values}
    report: dict[str, Any] = {
        "law": chosen.kind,
        "chosen_by": "least Bayesian information criterion" if law == "auto" else "asked for",
        "velocity_stderr_m_per_s": [errors[f"velocity_{a}"] for a in "xyz"],
        "omega_stderr_rad_per_s": [errors[f"omega_{a}"] for a in "xyz"],
        "ground_stderr_m": errors.get("ground_offset"),
        "independent_samples": chosen.samples,
        "rollouts": sum(f.rollouts for f in fits),
    }
    if law == "auto":
        report["families"] = family_rows(fits) + [{"law": kind, "failed": why} for kind, why in failures.items()]
    return Found(chosen.law, chosen.motion, chosen.contact, chosen.error_m, report)


def _fits(
    kinds: list[str], few: Problem, motion: Motion, first_frames: int, checkpoint: Checkpoint, progress: Progress
) -> tuple[list[FamilyFit], dict[str, str]]:
    """The fits of ``kinds`` on few particles, and why the others failed. Raises MasivError where all did."""
    fits: list[FamilyFit] = []
    failures: dict[str, str] = {}
    for kind in kinds:
        try:
            fits.append(fit_family(kind, few, motion, first_frames, checkpoint, progress))
        except MasivError as failed:
            if len(kinds) == 1:
                raise
            failures[kind] = str(failed)
    if not fits:
        raise MasivError(f"identify: no classical law explains the motion ({next(iter(failures.values()))})")
    return fits, failures


def family_rows(fits: list[FamilyFit]) -> list[dict[str, Any]]:
    """Errors and parameters of each family, best first, as fitted on few particles."""
    samples = min(fits, key=lambda f: f.mean_square).samples
    criteria = {f.kind: information_criterion(f, samples) for f in fits}
    least = min(criteria.values())
    return [
        {
            "law": f.kind,
            "trajectory_error_mm": 1e3 * f.error_m,
            "bic_above_best": criteria[f.kind] - least,
            "contact": f.contact,
            "parameters": f.law.description()["parameters"],
        }
        for f in sorted(fits, key=lambda f: criteria[f.kind])
    ]


def _known(error: float) -> float | None:
    return error if math.isfinite(error) else None
