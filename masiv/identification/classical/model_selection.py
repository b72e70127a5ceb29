"""Which of several fitted law families explains the motion?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from masiv.errors import NonFiniteError
from masiv.identification.classical.fit import FamilyFit
from masiv.identification.losses.objective import Objective

IMAGE_LOSS_TIE = 1.1
"""Families whose image loss is at most this factor of the least one are equal: few particles show no smaller
difference."""


def information_criteria(fits: Sequence[FamilyFit]) -> dict[str, float]:
    """Bayesian information criterion of normal residuals by family, up to a constant.

    n ln(mean square) + k ln(n), with k parameters and the n of the fit with the least mean square.
    """
    samples = max(1, min(fits, key=lambda f: f.mean_square).samples)
    return {f.kind: samples * math.log(max(f.mean_square, 1e-300)) + len(f.values) * math.log(samples) for f in fits}


def rank_by_bic(fits: Sequence[FamilyFit]) -> list[FamilyFit]:
    """``fits``, the one with the least Bayesian information criterion first."""
    criteria = information_criteria(fits)
    return sorted(fits, key=lambda f: criteria[f.kind])


def image_losses(objective: Objective, fits: Sequence[FamilyFit]) -> dict[str, float]:
    """Image loss of each family's rollout, with the weights of the surface finetune; infinite if it diverges.

    Empty if there are no pictures to compare with.
    """
    if not objective.compares_images:
        return {}
    finetune = objective.with_surface_loss(0)

    def loss(fit: FamilyFit) -> float:
        try:
            errors = finetune.whole_image_errors(finetune.whole_rollout(fit.law, fit.initial_state, fit.contact))
            return float(finetune.image_loss(errors).mean())
        except NonFiniteError:
            return math.inf

    return {fit.kind: loss(fit) for fit in fits}


def rank_by_image_loss(fits: Sequence[FamilyFit], losses: Mapping[str, float]) -> list[FamilyFit]:
    """``fits`` by image loss; among those that are equal to the best (``IMAGE_LOSS_TIE``) the one with the fewest
    parameters first. By ``rank_by_bic`` if there are no ``losses``.

    The paths of a body that flows are wrong, and a wrong law may be nearer to them: after short fits the paths of a
    viscous sphere prefer a fluid with a yield stress by a quarter of their error, the pictures the true fluid by a
    third.
    """
    if not losses:
        return rank_by_bic(fits)
    tie = IMAGE_LOSS_TIE * min(losses.values())
    return sorted(fits, key=lambda f: (len(f.values) if losses[f.kind] <= tie else math.inf, losses[f.kind]))


def family_rows(ranked: Sequence[FamilyFit], losses: Mapping[str, float]) -> list[dict[str, Any]]:
    """Errors and parameters of each of the ``ranked`` families, as fitted with few particles.

    losses: image losses, empty if there are no pictures.
    """
    criteria = information_criteria(ranked)
    return [
        {
            "law": f.kind,
            "trajectory_error_mm": 1e3 * f.error_m,
            "image_loss": losses.get(f.kind),
            "bic_above_best": criteria[f.kind] - min(criteria.values()),
            "contact": f.contact,
            "parameters": f.law.description()["parameters"],
        }
        for f in ranked
    ]
