"""What a fit compares: rollouts of a body with its observed paths and with the pictures."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv.effects.effect import Effect
from masiv.identify.config import IdentifyConfig
from masiv.identify.geometry_loss import chamfer_error, surface_points, trajectory_error
from masiv.models.deformable import HeldSubsteps, failures_as_divergence
from masiv.models.families import Family, law_of
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState
from masiv.mpm.config import SimulatorConfig
from masiv.observations.motion import Observed
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.identify.paint import Paint


class Problem(FilmedBody):
    """A filmed body with the settings of its fit: ``config.samples_per_frame`` instants a frame are compared."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Observed,
        config: IdentifyConfig,
        simulator: SimulatorConfig,
        *,
        chosen: np.ndarray | None = None,
        known: Sequence[tuple[Effect, torch.Tensor]] = (),
    ) -> None:
        """See ``FilmedBody``."""
        super().__init__(scene, trajectory, simulator, samples=config.samples_per_frame, chosen=chosen, known=known)
        self.config = config
        self.surface: torch.Tensor | None = None
        if config.geometry_loss == "surface":
            on_surface = surface_points(trajectory.evaluate(np.zeros(1))[0])
            self.surface = torch.from_numpy(np.flatnonzero(on_surface[self.chosen]))

    @property
    def ground_range(self) -> float:
        """Greatest offset [m] of the effective ground, 0 if there is no ground."""
        return 0.0 if self.scene.ground is None else self.config.ground_range

    def of_surfaces(self, iterations: int) -> Problem:
        """The same with ``iterations``, the loss "surface" and more weight of the pictures."""
        c = self.config
        weights = {"silhouette_weight": c.polish_silhouette_weight, "paint_weight": c.polish_paint_weight}
        other = copy.copy(self)
        other.config = c.model_copy(update={"geometry_loss": "surface", "iterations": iterations, **weights})
        other.surface = torch.from_numpy(np.flatnonzero(surface_points(self.particles.numpy())))
        return other

    @functools.cached_property
    def blob_size(self) -> float:
        """See ``masiv.identify.pictures.blob_size``; [m]."""
        from masiv.identify.pictures import blob_size

        return blob_size(self)

    @functools.cached_property
    def paint(self) -> Paint | None:
        """The particles' paint, None where no weight is given to it."""
        from masiv.identify.paint import paint

        return (
            paint(self)
            if self.scene.views and max(self.config.paint_weight, self.config.polish_paint_weight) > 0
            else None
        )

    def error(self, positions: torch.Tensor) -> torch.Tensor:
        """Mean distance [m] to the observed trajectories, positions (K, N, 3) from the start."""
        return trajectory_error(positions, self.targets[: len(positions)])

    def geometry_error(self, positions: torch.Tensor) -> torch.Tensor:
        """What ``config.geometry_loss`` compares, [m]; zero where that is none. positions as of ``error``."""
        if self.config.geometry_loss == "trajectory":
            return self.error(positions)
        if self.config.geometry_loss == "none":
            return torch.zeros(())
        here, there = (p[self.samples - 1 :: self.samples] for p in (positions, self.targets[: len(positions)]))
        if self.surface is not None:
            here, there = here[:, self.surface], there[:, self.surface]
        return chamfer_error(here, there)


class PathResidual:
    """Residual (K, N, 3) [m], simulated less observed, of values of a law and an initial state over the first
    ``frames`` frames. The substep is that of the first law, see ``HeldSubsteps``."""

    def __init__(self, problem: Problem, family: Family, contact: str, frames: int) -> None:
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
