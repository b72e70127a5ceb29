"""Paths first, then surfaces: what pictures tell for certain has the last word.

Paths of particles say which matter went where, and lead a fit from far away. In a body that flows they drift with what
the pictures do not show, and a law that is fitted to them learns the drift. Surfaces, silhouettes and paint do not
drift.
"""

from __future__ import annotations

from masiv.checkpoint import Checkpoint
from masiv.identify.fit import Fit, fit
from masiv.identify.pictures import compared, picture_objective, shown
from masiv.identify.problem import Problem
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress


def wanted(problem: Problem) -> bool:
    """Whether surfaces have the last word: a fit to paths that has pictures to be judged by."""
    return problem.config.polish and problem.config.geometry_loss == "trajectory" and compared(problem)


def polish(
    problem: Problem,
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
    surfaces = problem.of_surfaces(problem.config.iterations // 2)
    other = fit(
        surfaces, fitted.law, fitted.motion, contact, surfaces.frames,
        seed=seed, checkpoint=checkpoint, prior=prior,
        progress=lambda _, *rest: progress("identify: fit surfaces", *rest),
    )  # fmt: skip
    other.history = [*fitted.history, *((i + problem.config.iterations, *rest) for i, *rest in other.history)]
    seen = {name: shown(surfaces, f.law, f.motion, contact) for name, f in (("paths", fitted), ("surfaces", other))}
    report = {f"silhouette_error_of_{name}": float(errors[0]) for name, errors in seen.items()}
    if problem.paint is not None:
        report |= {f"paint_error_of_{name}": float(errors[1]) for name, errors in seen.items()}
    before, after = (float(picture_objective(surfaces, errors)) for errors in seen.values())
    return (other, after, report) if after < before else (fitted, before, report)
