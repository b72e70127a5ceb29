"""What the fit of a classical law makes small: distances to the observed paths, or these with the pictures beside
them, which have the last word."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.identify.pictures import VIEWS, beside_pictures, some_of_each
from masiv.identify.problem import PathResidual, Problem
from masiv.models.families import Family


class Misfit:
    """Residuals of ``values`` over the first ``frames``, in two parts: (K, N, 3) [m] of the paths, and flat those that
    are squared and added up.

    pictures: those are of paths in units of the body's size, of silhouettes pixel by pixel over the mask's area, and of
    the paint of each picture, weighed as in the last iterations of a neural law; else they are of paths alone, in
    metres. chosen: particles whose paths are added up, all where None.
    """

    def __init__(
        self, problem: Problem, family: Family, contact: str, frames: int,
        *, pictures: bool, chosen: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.problem = problem
        self.rollouts = PathResidual(problem, family, contact, frames)
        self.frames = frames
        self.pictures = pictures
        self.chosen = np.arange(problem.count) if chosen is None else chosen
        self.rows = 3 * frames * problem.samples * len(self.chosen)
        self.per_metre = math.sqrt(3 / self.rows) / problem.size if pictures else 1.0

    def of_paths(self, squared: np.ndarray) -> np.ndarray:
        """The part of residuals, or of their derivatives (M, ...), that is of paths, in metres."""
        return squared[: self.rows] / self.per_metre

    def __call__(self, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Raises NonFiniteError as ``PathResidual.field``."""
        paths = self.rollouts.field(values)
        parts = [self.per_metre * paths[:, self.chosen].ravel()]
        if self.pictures:
            problem, config = self.problem, self.problem.config
            positions = torch.from_numpy(paths).float() + problem.targets[: len(paths)]
            pictures = some_of_each(problem, self.frames, VIEWS)
            with torch.no_grad():
                for outline, paint in beside_pictures(problem, positions, pictures):
                    parts.append(outline.ravel().numpy() * math.sqrt(config.polish_silhouette_weight / len(pictures)))
                    parts.append(np.sqrt([float(paint) * config.polish_paint_weight / len(pictures)]))
        return paths, np.concatenate(parts)
