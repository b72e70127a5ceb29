"""What a reconstruction minimises: pictures (MASIV's dynamic-Gaussian loss) and what keeps points from sliding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from masiv.scene.scene import Ground
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.losses import ssim, strain
from masiv.splat.observe import Observation
from masiv.splat.pull import HullPull
from masiv.splat.rasteriser import render

PULLED = 700
"""Gaussians, and points of a hull, that one step measures."""


@dataclass(frozen=True)
class Objective:
    """The loss of a fit. scale and half_extent [m] make lengths comparable; ``hulls`` pull, one for each frame
    that is drawn."""

    config: ReconstructConfig
    scale: float
    half_extent: float
    fps: float
    ground: Ground | None
    hulls: Sequence[HullPull] | Mapping[int, HullPull]

    def __call__(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: tuple[torch.Tensor, torch.Tensor],
        pictures: list[tuple[int, Observation]],
        pull: float,
        rng: np.random.Generator,
    ) -> torch.Tensor:
        """The loss, a scalar, on ``pictures`` (frame, observation).

        gaussians: means (N, 3) [m], log_scales, opacity_logits (N,), colour_logits (N, 3); pairs: neighbours;
        pull in [0, 1] scales the hulls' weight; rng draws backgrounds and the points that are pulled.
        """
        c, means = self.config, gaussians["means"]
        opacities, colours = torch.sigmoid(gaussians["opacity_logits"]), torch.sigmoid(gaussians["colour_logits"])
        loss = c.scale_weight * gaussians["log_scales"].exp().mean() / self.scale
        frames = sorted({frame for frame, _ in pictures})
        displacements, log_changes = torch.zeros(len(frames), len(means), 3), torch.zeros(len(frames), len(means))
        if frames[-1] > 0:
            # Positions go into the network without a gradient, as in MASIV: the motion answers for the motion.
            displacements, log_changes = network.changes(means.detach(), torch.tensor(frames) / self.fps)
            loss = loss + self._regularisers(means.detach(), displacements, frames, pairs, pull, rng)
        for frame, view in pictures:
            k = frames.index(frame)
            background = torch.tensor(rng.random(3), dtype=torch.float32)
            scales = (gaussians["log_scales"] + log_changes[k]).exp()
            drawn = render(view.camera, means + displacements[k], scales, opacities, colours, background)
            loss = loss + self._difference(drawn.rgb, drawn.alpha, view, background) / len(pictures)
        return loss

    def _regularisers(
        self,
        means: torch.Tensor,
        displacements: torch.Tensor,
        frames: list[int],
        pairs: tuple[torch.Tensor, torch.Tensor],
        pull: float,
        rng: np.random.Generator,
    ) -> torch.Tensor:
        """Strain between neighbours, depth below the ground, distance from the last frame's hull."""
        c = self.config
        total = c.rigidity_weight * strain(means, displacements, *pairs, softening=self.scale)
        if self.ground is not None:
            normal = torch.tensor(self.ground.normal, dtype=torch.float32)
            below = torch.relu(float(self.ground.height) - (means + displacements) @ normal)
            total = total + c.ground_weight * below.mean() / self.half_extent
        if c.hull_weight * pull > 0:
            far = self.hulls[frames[-1]](means + displacements[-1], PULLED, rng)
            total = total + c.hull_weight * pull * far / self.half_extent
        return total

    def _difference(
        self, rgb: torch.Tensor, alpha: torch.Tensor, view: Observation, background: torch.Tensor
    ) -> torch.Tensor:
        """(1 - l) L1 + l (1 - SSIM) over the background, plus alpha against the mask; what an occluder hides agrees."""
        c = self.config
        target = view.colour + (1 - view.mask)[..., None] * background
        rgb = torch.lerp(target, rgb, view.valid[..., None])
        absolute = (rgb - target).abs().mean()
        silhouette = ((alpha - view.mask) * view.valid).abs().mean()
        return (1 - c.ssim_weight) * absolute + c.ssim_weight * (1 - ssim(rgb, target)) + c.alpha_weight * silhouette
