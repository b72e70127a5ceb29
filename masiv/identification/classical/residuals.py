"""Residuals of a classical law's fit: distances to the observed paths, alone or with the pictures."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.identification.losses.images import pictures_of_each_frame
from masiv.identification.losses.objective import VIEWS_COMPARED, Objective
from masiv.models.deformable import HeldSubsteps, failures_as_divergence
from masiv.models.families import Family, law_of
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState


class PathResidual:
    """Paths, simulated less observed, over the first ``frames`` frames: (K, N, 3) [m] as a function of the values of a
    law and an initial state. The substep is that of the first law, see ``HeldSubsteps``."""

    def __init__(self, problem: FilmedBody, family: Family, contact: str, frames: int) -> None:
        self.problem = problem
        self.family = family
        self.contact = contact
        self.frames = frames
        self.held = HeldSubsteps()

    @torch.no_grad()
    def field(self, values: dict[str, float]) -> np.ndarray:
        """Raises NonFiniteError if the rollout diverges, spreads without bound or is too stiff to be simulated."""
        law, start = law_of(self.family, values), InitialState.of_values(values)
        with failures_as_divergence():
            steps = self.problem.held_substeps(law, self.held, self.family.kind)
            positions = self.problem.run(law, start, self.contact, self.frames, steps=steps)
        return (positions - self.problem.targets[: len(positions)]).double().numpy()


class JointResidual:
    """Residuals over the first ``frames`` frames, in two forms: the paths (K, N, 3) [m], and a vector (M,) whose sum of
    squares is minimised.

    Without images the vector has the paths alone, in metres. With images it has the paths in units of the body's size,
    alpha - mask of each pixel over the root of the mask's area, and the root of the color error of each picture,
    weighted as in the surface finetune of a neural law. chosen: indices of the particles whose paths are in the vector;
    all if None.
    """

    def __init__(
        self, objective: Objective, family: Family, contact: str, frames: int,
        *, with_images: bool, chosen: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        problem = objective.problem
        self.objective = objective
        self.rollouts = PathResidual(problem, family, contact, frames)
        self.frames = frames
        self.with_images = with_images
        self.chosen = np.arange(problem.count) if chosen is None else chosen
        self.path_rows = 3 * frames * problem.samples * len(self.chosen)
        self.per_metre = math.sqrt(3 / self.path_rows) / problem.size if with_images else 1.0

    def path_part(self, vector: np.ndarray) -> np.ndarray:
        """The paths' part [m] of a residual vector (M,) or of its derivatives (M, P)."""
        return vector[: self.path_rows] / self.per_metre

    def __call__(self, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Paths (K, N, 3) [m] and vector (M,). Raises NonFiniteError as ``PathResidual.field``."""
        paths = self.rollouts.field(values)
        parts = [self.per_metre * paths[:, self.chosen].ravel()]
        if self.with_images:
            parts += self._image_parts(paths)
        return paths, np.concatenate(parts)

    @torch.no_grad()
    def _image_parts(self, paths: np.ndarray) -> list[np.ndarray]:
        problem, config = self.objective.problem, self.objective.config
        positions = torch.from_numpy(paths).float() + problem.targets[: len(paths)]
        pictures = pictures_of_each_frame(problem.scene.views, self.frames, VIEWS_COMPARED)
        parts = []
        for silhouette, color in self.objective.images.residuals(positions, pictures):
            parts.append(silhouette.ravel().numpy() * math.sqrt(config.finetune_silhouette_weight / len(pictures)))
            parts.append(np.sqrt([float(color) * config.finetune_color_weight / len(pictures)]))
        return parts
