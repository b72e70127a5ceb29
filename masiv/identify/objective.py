"""What a rollout over all fitted frames is judged by."""

from __future__ import annotations

import torch

from masiv.identify.pictures import compared, picture_errors, picture_objective, some_of_each
from masiv.identify.problem import Problem


@torch.no_grad()
def objective(problem: Problem, positions: torch.Tensor) -> float:
    """What a fit makes small, with the same pictures each time: geometry in units of the body's size, silhouettes and
    paint. positions (K, N, 3) [m, simulation frame] as ``Problem.run`` has them, over all frames."""
    value = problem.config.trajectory_weight * problem.geometry_error(positions) / problem.size
    if compared(problem):
        shown = picture_errors(problem, positions, some_of_each(problem, problem.frames))
        value = value + picture_objective(problem, shown)
    return float(value)
