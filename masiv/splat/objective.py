"""The loss of a reconstruction: images (MASIV's dynamic-Gaussian loss) and regularization of the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from masiv.scene.scene import Ground
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.hull_loss import HullLoss
from masiv.splat.losses import Pairs, depth_distance, ssim, strain
from masiv.splat.observed_image import ObservedImage
from masiv.splat.rasteriser import render

PARAMETER_NAMES = ("means", "log_scales", "opacity_logits", "colour_logits")
"""The parameters of the Gaussians."""
HULL_SAMPLES = 700
"""Gaussians, and surface points of a hull, that one step compares."""


@dataclass(frozen=True)
class Part:
    """A part of the loss of one step, with its random numbers drawn.

    images: (frame, index of its image, background (3,)), frames ascending; image_count: images of the whole step.
    regularized: frames whose strain and ground terms this part contains; frame_count: frames of the whole step.
    hull: Gaussians and surface points that are compared with the hull of the last frame, and the weight of the term.
    scale_term: whether this part contains the term of the mean scale.
    """

    images: tuple[tuple[int, int, np.ndarray], ...]
    image_count: int
    regularized: tuple[int, ...]
    frame_count: int
    hull: tuple[np.ndarray, np.ndarray, float] | None
    scale_term: bool


@dataclass(frozen=True)
class Objective:
    """The loss of a fit.

    scale, half_extent [m]: lengths that make the terms dimensionless; fps [1/s]. hulls, images: by frame.
    """

    config: ReconstructConfig
    scale: float
    half_extent: float
    fps: float
    ground: Ground | None
    hulls: Sequence[HullLoss] | Mapping[int, HullLoss]
    images: Sequence[list[ObservedImage]] | Mapping[int, list[ObservedImage]]

    def __call__(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: Pairs,
        chosen: list[tuple[int, int]],
        hull_factor: float,
        rng: np.random.Generator,
    ) -> torch.Tensor:
        """The loss of one step, a scalar: the sum over ``parts``."""
        parts = self.parts(len(gaussians["means"]), chosen, hull_factor, rng)
        return torch.stack([self.part(gaussians, network, pairs, part) for part in parts]).sum()

    def parts(
        self, count: int, chosen: list[tuple[int, int]], hull_factor: float, rng: np.random.Generator
    ) -> tuple[Part, ...]:
        """The loss of one step in two parts of about equal cost, or in one part for a single image.

        The second part has fewer images, but the hull and scale terms. count: Gaussians; chosen: (frame, index of its
        image); hull_factor in [0, 1] multiplies the weight of the hull; rng draws backgrounds and hull samples.
        """
        last = max(frame for frame, _ in chosen)
        weight = self.config.hull_weight * hull_factor
        hull = (*self.hulls[last].draw(count, HULL_SAMPLES, rng), weight) if last > 0 and weight > 0 else None
        drawn = sorted(((*image, rng.random(3)) for image in chosen), key=lambda image: image[0])
        cut = len(drawn) - len(drawn) // 2
        frames = {frame for frame, *_ in drawn}
        later = {frame for frame, *_ in drawn[cut:]}

        def part(images: list, regularized: set[int], last: bool) -> Part:
            return Part(
                tuple(images),
                len(drawn),
                tuple(sorted(regularized)),
                len(frames),
                hull if last else None,
                scale_term=last,
            )

        if cut == len(drawn):
            return (part(drawn, frames, last=True),)
        return part(drawn[:cut], frames - later, last=False), part(drawn[cut:], later, last=True)

    def part(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: Pairs,
        part: Part,
    ) -> torch.Tensor:
        """The loss of ``part``, a scalar.

        gaussians: means (N, 3) [m], log_scales, opacity_logits (N,), colour_logits (N, 3). pairs: neighbours.
        """
        c, means = self.config, gaussians["means"]
        opacities, colours = torch.sigmoid(gaussians["opacity_logits"]), torch.sigmoid(gaussians["colour_logits"])
        loss = means.new_zeros(())
        if part.scale_term:
            loss = loss + c.scale_weight * gaussians["log_scales"].exp().mean() / self.scale
        frames = sorted({frame for frame, *_ in part.images})
        displacements, log_changes = torch.zeros(len(frames), len(means), 3), torch.zeros(len(frames), len(means))
        if frames[-1] > 0:
            # As in MASIV, the network gets positions without a gradient: errors of the motion change the motion only.
            displacements, log_changes = network.changes(means.detach(), torch.tensor(frames) / self.fps)
            loss = loss + self._regularization(means.detach(), displacements, frames, pairs, part)
        for frame, index, drawn_background in part.images:
            k, observed = frames.index(frame), self.images[frame][index]
            background = torch.tensor(drawn_background, dtype=torch.float32)
            scales = (gaussians["log_scales"] + log_changes[k]).exp()
            drawn = render(observed.camera, means + displacements[k], scales, opacities, colours, background)
            loss = loss + self._image_loss(drawn.rgb, drawn.alpha, observed, background) / part.image_count
            if observed.depth is not None and c.depth_weight > 0:
                distance = depth_distance(drawn.depth, drawn.alpha, observed.depth)
                loss = loss + c.depth_weight * distance / (self.half_extent * part.image_count)
        return loss

    def _regularization(
        self,
        means: torch.Tensor,
        displacements: torch.Tensor,
        frames: list[int],
        pairs: Pairs,
        part: Part,
    ) -> torch.Tensor:
        """Strain between neighbours, depth below the ground, distance to the hull of the last frame."""
        c = self.config
        total = means.new_zeros(())
        if part.regularized:
            fraction = len(part.regularized) / part.frame_count
            here = displacements if len(part.regularized) == len(frames) else displacements[
                [frames.index(frame) for frame in part.regularized]
            ]  # fmt: skip
            total = total + fraction * c.rigidity_weight * strain(means, here, *pairs, softening=self.scale)
            if self.ground is not None:
                normal = torch.tensor(self.ground.normal, dtype=torch.float32)
                below = torch.relu(float(self.ground.height) - (means + here) @ normal)
                total = total + fraction * c.ground_weight * below.mean() / self.half_extent
        if part.hull is not None:
            chosen, surface, weight = part.hull
            distance = self.hulls[frames[-1]](means + displacements[-1], chosen, surface)
            total = total + weight * distance / self.half_extent
        return total

    def _image_loss(
        self, rgb: torch.Tensor, alpha: torch.Tensor, observed: ObservedImage, background: torch.Tensor
    ) -> torch.Tensor:
        """(1 - l) L1 + l (1 - SSIM) over the background, plus L1 of alpha and mask. Occluded pixels have no error."""
        c = self.config
        target = observed.colour + (1 - observed.mask)[..., None] * background
        rgb = torch.lerp(target, rgb, observed.valid[..., None])
        absolute = (rgb - target).abs().mean()
        silhouette = ((alpha - observed.mask) * observed.valid).abs().mean()
        return (1 - c.ssim_weight) * absolute + c.ssim_weight * (1 - ssim(rgb, target)) + c.alpha_weight * silhouette
