"""What a reconstruction minimises: pictures (MASIV's dynamic-Gaussian loss) and what keeps points from sliding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from masiv.scene.scene import Ground
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.losses import Pairs, ssim, strain
from masiv.splat.observed_image import ObservedImage
from masiv.splat.pull import HullPull
from masiv.splat.rasteriser import render

NAMES = ("means", "log_scales", "opacity_logits", "colour_logits")
"""The Gaussians' parameters."""
PULLED = 700
"""Gaussians, and points of a hull, that one step measures."""


@dataclass(frozen=True)
class Part:
    """A part of a step's loss, whose random numbers are drawn. pictures: (frame, which of its observations, background
    (3,)), frames ascending, ``of_pictures`` in the step; measured: frames whose strain and ground count here, of
    ``of_frames``; pulled: Gaussians and points of the last frame's hull, and the pull's weight; sizes: whether the mean
    size counts here."""

    pictures: tuple[tuple[int, int, np.ndarray], ...]
    of_pictures: int
    measured: tuple[int, ...]
    of_frames: int
    pulled: tuple[np.ndarray, np.ndarray, float] | None
    sizes: bool


@dataclass(frozen=True)
class Objective:
    """The loss of a fit. scale and half_extent [m] make lengths comparable; ``observations`` of each frame that is
    drawn, and the hulls that pull there."""

    config: ReconstructConfig
    scale: float
    half_extent: float
    fps: float
    ground: Ground | None
    hulls: Sequence[HullPull] | Mapping[int, HullPull]
    observations: Sequence[list[ObservedImage]] | Mapping[int, list[ObservedImage]]

    def __call__(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: Pairs,
        pictures: list[tuple[int, int]],
        pull: float,
        rng: np.random.Generator,
    ) -> torch.Tensor:
        """The loss, a scalar: the sum of its ``parts``."""
        parts = self.parts(len(gaussians["means"]), pictures, pull, rng)
        return torch.stack([self.part(gaussians, network, pairs, part) for part in parts]).sum()

    def parts(
        self, count: int, pictures: list[tuple[int, int]], pull: float, rng: np.random.Generator
    ) -> tuple[Part, ...]:
        """A step on ``pictures`` (frame, which of its observations), in parts that take about as long as each other:
        the second has fewer pictures, but hull and sizes. One part where there is one picture.

        count: Gaussians; pull in [0, 1] scales the hulls' weight; rng draws backgrounds and the points that are pulled.
        """
        last = max(frame for frame, _ in pictures)
        weight = self.config.hull_weight * pull
        pulled = (*self.hulls[last].draw(count, PULLED, rng), weight) if last > 0 and weight > 0 else None
        drawn = sorted(((*picture, rng.random(3)) for picture in pictures), key=lambda picture: picture[0])
        cut = len(drawn) - len(drawn) // 2
        frames = {frame for frame, *_ in drawn}
        later = {frame for frame, *_ in drawn[cut:]}

        def part(some: list, measured: set[int], last: bool) -> Part:
            return Part(
                tuple(some), len(drawn), tuple(sorted(measured)), len(frames), pulled if last else None, sizes=last
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

        gaussians: means (N, 3) [m], log_scales, opacity_logits (N,), colour_logits (N, 3); pairs: neighbours.
        """
        c, means = self.config, gaussians["means"]
        opacities, colours = torch.sigmoid(gaussians["opacity_logits"]), torch.sigmoid(gaussians["colour_logits"])
        loss = means.new_zeros(())
        if part.sizes:
            loss = loss + c.scale_weight * gaussians["log_scales"].exp().mean() / self.scale
        frames = sorted({frame for frame, *_ in part.pictures})
        displacements, log_changes = torch.zeros(len(frames), len(means), 3), torch.zeros(len(frames), len(means))
        if frames[-1] > 0:
            # Positions go into the network without a gradient, as in MASIV: the motion answers for the motion.
            displacements, log_changes = network.changes(means.detach(), torch.tensor(frames) / self.fps)
            loss = loss + self._regularisers(means.detach(), displacements, frames, pairs, part)
        for frame, which, drawn_background in part.pictures:
            k, view = frames.index(frame), self.observations[frame][which]
            background = torch.tensor(drawn_background, dtype=torch.float32)
            scales = (gaussians["log_scales"] + log_changes[k]).exp()
            drawn = render(view.camera, means + displacements[k], scales, opacities, colours, background)
            loss = loss + self._difference(drawn.rgb, drawn.alpha, view, background) / part.of_pictures
        return loss

    def _regularisers(
        self,
        means: torch.Tensor,
        displacements: torch.Tensor,
        frames: list[int],
        pairs: Pairs,
        part: Part,
    ) -> torch.Tensor:
        """Strain between neighbours, depth below the ground, distance from the last frame's hull."""
        c = self.config
        total = means.new_zeros(())
        if part.measured:
            share = len(part.measured) / part.of_frames
            here = displacements if len(part.measured) == len(frames) else displacements[
                [frames.index(frame) for frame in part.measured]
            ]  # fmt: skip
            total = total + share * c.rigidity_weight * strain(means, here, *pairs, softening=self.scale)
            if self.ground is not None:
                normal = torch.tensor(self.ground.normal, dtype=torch.float32)
                below = torch.relu(float(self.ground.height) - (means + here) @ normal)
                total = total + share * c.ground_weight * below.mean() / self.half_extent
        if part.pulled is not None:
            inside, outside, weight = part.pulled
            far = self.hulls[frames[-1]](means + displacements[-1], inside, outside)
            total = total + weight * far / self.half_extent
        return total

    def _difference(
        self, rgb: torch.Tensor, alpha: torch.Tensor, view: ObservedImage, background: torch.Tensor
    ) -> torch.Tensor:
        """(1 - l) L1 + l (1 - SSIM) over the background, plus alpha against the mask; what an occluder hides agrees."""
        c = self.config
        target = view.colour + (1 - view.mask)[..., None] * background
        rgb = torch.lerp(target, rgb, view.valid[..., None])
        absolute = (rgb - target).abs().mean()
        silhouette = ((alpha - view.mask) * view.valid).abs().mean()
        return (1 - c.ssim_weight) * absolute + c.ssim_weight * (1 - ssim(rgb, target)) + c.alpha_weight * silhouette
