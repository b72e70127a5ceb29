"""Paths first, then surfaces: what pictures tell for certain has the last word.

Paths of particles say which matter went where, and lead a fit from far away. In a body that flows they drift with what
the pictures do not show, and a law that is fitted to them learns the drift. Surfaces, silhouettes and paint do not
drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from masiv.checkpoint import Checkpoint
from masiv.identify.fit import Fit, fit
from masiv.identify.pictures import compared, picture_objective, shown
from masiv.identify.problem import Problem
from masiv.identify.throw import Throw
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress


def wanted(problem: Problem) -> bool:
    """Whether surfaces have the last word: a fit to paths that has pictures to be judged by."""
    return problem.config.polish and problem.config.geometry_loss == "trajectory" and compared(problem)


def polish(
    throws: Sequence[Throw],
    fitted: Fit,
    contact: str,
    prior: NeuralLaw,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> tuple[Fit, float, dict[str, float]]:
    """``fitted``, a neural law, after half as many iterations with surfaces in place of paths, or as it is where it
    was nearer to the pictures; ``picture_objective`` of what is kept; and how near both are."""
    before = throws[0].problem.config.iterations
    surfaces = [t.problem.of_surfaces(before // 2) for t in throws]
    goes_on = [Throw(p, motion, p.frames) for p, motion in zip(surfaces, fitted.motions, strict=True)]
    other = fit(
        goes_on, fitted.law, contact, seed=seed, checkpoint=checkpoint, prior=prior,
        progress=lambda _, *rest: progress("identify: fit surfaces", *rest),
    )  # fmt: skip
    other.history = [*fitted.history, *((i + before, *rest) for i, *rest in other.history)]
    seen = {name: _shown(surfaces, f, contact) for name, f in (("paths", fitted), ("surfaces", other))}
    report = {f"silhouette_error_of_{name}": float(errors[0]) for name, errors in seen.items()}
    if surfaces[0].paint is not None:
        report |= {f"paint_error_of_{name}": float(errors[1]) for name, errors in seen.items()}
    was, now = (float(picture_objective(surfaces[0], errors)) for errors in seen.values())
    return (other, now, report) if now < was else (fitted, was, report)


def _shown(surfaces: Sequence[Problem], fitted: Fit, contact: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean errors of silhouettes and paint over all throws."""
    every = [shown(p, fitted.law, motion, contact) for p, motion in zip(surfaces, fitted.motions, strict=True)]
    outlines, paints = zip(*every, strict=True)
    return torch.stack(outlines).mean(), torch.stack(paints).mean()
