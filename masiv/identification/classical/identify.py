"""Identification with a classical law: a named family, or the one that explains the motion best."""

from __future__ import annotations

import math
from typing import Any

from masiv.checkpoint import Checkpoint
from masiv.identification.classical.fit import FamilyFit, fit_all_particles, fit_family
from masiv.identification.classical.model_selection import family_rows, image_losses, rank_by_image_loss
from masiv.identification.classical.shortlist import FamilyFits, fit_shortlist
from masiv.identification.losses.objective import Objective
from masiv.identification.recording import FitRecording
from masiv.progress import Progress
from masiv.workers import workers_for

CHOSEN_BY_IMAGES = "least image loss; the law with fewer parameters if two are about equal"
CHOSEN_BY_BIC = "least Bayesian information criterion"


def fit_classical_law(
    kind: str, recording: FitRecording, coarse: Objective, checkpoint: Checkpoint, progress: Progress
) -> tuple[FamilyFit, dict[str, Any]]:
    """The law of family ``kind``, or of the best family if that is auto, and numbers for the twin's ``fit``.

    coarse: the objective of the recording with few particles, by which families are compared. The best one is then
    fitted to all particles. Raises MasivError if no family explains the motion.
    """
    objective = recording.objective
    with_images = objective.has_surface_finetune
    if kind == "auto":
        with workers_for(objective.config.processes, objective.config.scheduler, "identify.processes") as workers:
            found = fit_shortlist(
                coarse, recording.initial_state, recording.first_frames, with_images, checkpoint, progress, workers
            )
        losses = image_losses(coarse, list(found.fits.values()))
    else:
        fit = fit_family(
            kind, coarse, recording.initial_state, recording.first_frames, checkpoint, progress, with_images=with_images
        )
        found, losses = FamilyFits({kind: fit}), {}
    ranked = rank_by_image_loss(list(found.fits.values()), losses)
    best = fit_all_particles(ranked[0], coarse, objective, checkpoint, progress, with_images=with_images)
    report = _report(best, rollouts=best.rollouts + sum(f.rollouts for f in ranked[1:]))
    if kind != "auto":
        return best, {"law": best.kind, "chosen_by": "asked for", **report}
    failed = [{"law": failed, "failed": reason} for failed, reason in found.failures.items()]
    report |= {"families": [*family_rows(ranked, losses), *failed]}
    return best, {"law": best.kind, "chosen_by": CHOSEN_BY_IMAGES if losses else CHOSEN_BY_BIC, **report}


def _report(fit: FamilyFit, rollouts: int) -> dict[str, Any]:
    errors = {name: _finite(fit.stderr[name]) for name in fit.values if name not in fit.law.values}
    return {
        "velocity_stderr_m_per_s": [errors[f"velocity_{a}"] for a in "xyz"],
        "omega_stderr_rad_per_s": [errors[f"omega_{a}"] for a in "xyz"],
        "ground_stderr_m": errors.get("ground_offset"),
        "independent_samples": fit.samples,
        "rollouts": rollouts,
    }


def _finite(error: float) -> float | None:
    return error if math.isfinite(error) else None
