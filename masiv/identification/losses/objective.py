"""The objective of a fit (MASIV, section "Material-Agnostic System Identification", eq. 8, with a color term):

    J = w_geo L_geo / size + w_sil L_sil + w_col L_col

L_geo [m] is the geometry loss that the configuration names, ``size`` [m] the size of the body, L_sil and L_col the mean
errors of silhouettes and colors in some pictures.
"""

from __future__ import annotations

import numpy as np
import torch

from masiv.continuum.trajectory import Trajectory
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.geometry import chamfer_error, surface_points, trajectory_errors
from masiv.identification.losses.images import ImageTerms, pictures_of_each_frame
from masiv.materials.law import Law
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState

VIEWS_COMPARED = 3
"""Views of each frame in which finished fits are compared."""


class Objective:
    """The objective of one recording: rollouts of ``problem`` against its observed motion.

    config: weights and the kind of geometry loss. surface: indices (S,) of the particles
    on the surface if the geometry loss compares surfaces. images: shared with other objectives of the same problem.
    """

    def __init__(
        self,
        problem: FilmedBody,
        config: IdentifyConfig,
        *,
        surface: torch.Tensor | None = None,
        images: ImageTerms | None = None,
    ) -> None:
        self.problem = problem
        self.config = config
        self.surface = surface
        with_colors = max(self.config.color_weight, self.config.finetune_color_weight) > 0
        self.images = images or ImageTerms(problem, with_colors=with_colors)

    @classmethod
    def of(cls, problem: FilmedBody, trajectory: Trajectory, config: IdentifyConfig) -> Objective:
        """The objective that ``config`` asks for. trajectory: that of ``problem``."""
        if config.geometry_loss != "surface":
            return cls(problem, config)
        on_surface = surface_points(trajectory.positions[0])[problem.chosen]
        return cls(problem, config, surface=torch.from_numpy(np.flatnonzero(on_surface)))

    def with_surface_loss(self, iterations: int) -> Objective:
        """The objective of the surface finetune: surfaces in place of paths, more weight on the pictures."""
        surface = torch.from_numpy(np.flatnonzero(surface_points(self.problem.particles.numpy())))
        config = self.config.with_surface_loss(iterations)
        return Objective(self.problem, config, surface=surface, images=self.images)

    @property
    def ground_range(self) -> float:
        """Greatest offset [m] of the effective ground, 0 if there is no ground."""
        return 0.0 if self.problem.scene.ground is None else self.config.ground_range

    @property
    def compares_images(self) -> bool:
        """Whether there are pictures and they have a weight."""
        weights = self.config.silhouette_weight, self.config.color_weight
        return bool(self.problem.scene.views) and self.config.pictures > 0 and max(weights) > 0

    @property
    def has_surface_finetune(self) -> bool:
        """Whether surfaces and pictures are fitted after the paths."""
        return self.config.surface_finetune and self.config.geometry_loss == "trajectory" and self.compares_images

    def trajectory_errors(self, positions: torch.Tensor) -> torch.Tensor:
        """Mean distances (K,) [m] of ``positions`` (K, N, 3) [m, simulation frame] to the observed trajectories."""
        return trajectory_errors(positions, self.problem.targets[: len(positions)])

    def geometry_error(self, positions: torch.Tensor) -> torch.Tensor:
        """The geometry loss () [m] of ``config.geometry_loss``; 0 if that is none. ``positions`` as above."""
        if self.config.geometry_loss == "trajectory":
            return self.trajectory_errors(positions).mean()
        if self.config.geometry_loss == "none":
            return torch.zeros(())
        samples, targets = self.problem.samples, self.problem.targets[: len(positions)]
        simulated, observed = (p[samples - 1 :: samples] for p in (positions, targets))
        if self.surface is not None:
            simulated, observed = simulated[:, self.surface], observed[:, self.surface]
        return chamfer_error(simulated, observed)

    def image_loss(self, errors: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """w_sil L_sil + w_col L_col of the ``errors`` of silhouettes and colors, of any one shape."""
        return self.config.silhouette_weight * errors[0] + self.config.color_weight * errors[1]

    def loss(self, geometry_error: torch.Tensor, image_errors: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """J () of the geometry loss [m] and the mean errors of silhouettes and colors."""
        geometry = self.config.trajectory_weight * geometry_error / self.problem.size
        return geometry + self.image_loss(image_errors)

    def prepare(self, frames: int) -> None:
        """Compute now what ``evaluate`` of ``frames`` frames needs of the pictures: copies of this object have it."""
        if self.compares_images:
            self.images.prepare(pictures_of_each_frame(self.problem.scene.views, frames))

    @torch.no_grad()
    def evaluate(self, positions: torch.Tensor) -> float:
        """J of ``positions`` (K, N, 3) [m, simulation frame] over their frames, each time with the same pictures."""
        value = self.config.trajectory_weight * self.geometry_error(positions) / self.problem.size
        if self.compares_images:
            pictures = pictures_of_each_frame(self.problem.scene.views, len(positions) // self.problem.samples)
            value = value + self.image_loss(self.images.errors(positions, pictures))
        return float(value)

    @torch.no_grad()
    def whole_rollout(self, law: Law, initial_state: InitialState, contact: str) -> torch.Tensor:
        """Positions (K, N, 3) [m, simulation frame] over all frames, those at rest included. Raises NonFiniteError."""
        return self.problem.run(law, initial_state, contact, self.problem.frames)

    @torch.no_grad()
    def whole_image_errors(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Errors of silhouettes (T,) and colors (T,) of a ``whole_rollout``.

        They are means of ``VIEWS_COMPARED`` pictures of each frame.
        """
        problem = self.problem
        pictures = pictures_of_each_frame(problem.scene.views, problem.frames, VIEWS_COMPARED)
        silhouettes, colors = self.images.errors_by_picture(positions, pictures)
        return silhouettes.reshape(problem.frames, -1).mean(1), colors.reshape(problem.frames, -1).mean(1)
