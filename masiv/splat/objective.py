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
from masiv.splat.image_formation import Corrections, ImageFormation
from masiv.splat.losses import Pairs, depth_distance, ssim, strain
from masiv.splat.observed_image import ObservedImage
from masiv.splat.rasteriser import render
from masiv.splat.shutter import expose, velocities

PARAMETER_NAMES = ("means", "log_scales", "opacity_logits", "colour_logits")
"""The parameters of the Gaussians."""
HULL_SAMPLES = 700
"""Gaussians, and surface points of a hull, that one step compares."""


@dataclass(frozen=True)
class Part:
    """A part of the loss of one step, with its random numbers drawn.

    images: (frame, image, background (3,)), frames ascending; image_count: images of the whole step.
    regularized: frames whose strain and ground terms this part contains; frame_count: frames of the whole step.
    hull: Gaussians and surface points that are compared with the hull of the last frame, and the weight of the term.
    scale_term: whether this part contains the terms that belong to no image: mean scale, prior of the cameras.
    moving: whether the step has a frame after the first. A clock that is off shows there only.
    """

    images: tuple[tuple[int, ObservedImage, np.ndarray], ...]
    image_count: int
    regularized: tuple[int, ...]
    frame_count: int
    hull: tuple[np.ndarray, np.ndarray, float] | None
    scale_term: bool
    moving: bool = True


@dataclass(frozen=True)
class Moments:
    """When the motion is evaluated: times (K,) [s]; which of them is that of each image, and of each frame's terms.

    moving: whether anything can have moved by then.
    """

    times: torch.Tensor
    of_image: list[int]
    of_frame: dict[int, int]
    moving: bool


@dataclass(frozen=True)
class Objective:
    """The loss of a fit.

    scale, half_extent [m]: lengths that make the terms dimensionless; fps [1/s]. hulls, images: by frame.
    time_offsets [s]: of the clocks of the cameras that are fitted; empty if all are exact.
    """

    config: ReconstructConfig
    scale: float
    half_extent: float
    fps: float
    ground: Ground | None
    hulls: Sequence[HullLoss] | Mapping[int, HullLoss]
    images: Sequence[Sequence[ObservedImage]] | Mapping[int, Sequence[ObservedImage]]
    time_offsets: tuple[float, ...] = ()

    def __call__(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: Pairs,
        chosen: list[tuple[int, int]],
        hull_factor: float,
        rng: np.random.Generator,
        formation: ImageFormation | None = None,
    ) -> torch.Tensor:
        """The loss of one step, a scalar: the sum over ``parts``."""
        parts = self.parts(len(gaussians["means"]), chosen, hull_factor, rng)
        return torch.stack([self.part(gaussians, network, pairs, part, formation) for part in parts]).sum()

    def parts(
        self, count: int, chosen: list[tuple[int, int]], hull_factor: float, rng: np.random.Generator
    ) -> tuple[Part, ...]:
        """The loss of one step in two parts of about equal cost, or in one part for a single image.

        The second part has fewer images, but the hull and scale terms. count: Gaussians; chosen: (frame, index of its
        image); hull_factor in [0, 1] multiplies the weight of the hull; rng draws backgrounds and hull samples.
        """
        last = max(frame for frame, _ in chosen)
        moving = last > 0
        weight = self.config.hull_weight * hull_factor
        hull = (*self.hulls[last].draw(count, HULL_SAMPLES, rng), weight) if last > 0 and weight > 0 else None
        drawn = ((frame, self.images[frame][index], rng.random(3)) for frame, index in chosen)
        drawn = sorted(drawn, key=lambda image: image[0])
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
                moving=moving,
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
        formation: ImageFormation | None = None,
    ) -> torch.Tensor:
        """The loss of ``part``, a scalar.

        gaussians: means (N, 3) [m], log_scales, opacity_logits (N,), colour_logits (N, 3). pairs: neighbours.
        formation: corrections of cameras and exposures, and then their prior; None: all are as given.
        """
        c, means = self.config, gaussians["means"]
        opacities, colours = torch.sigmoid(gaussians["opacity_logits"]), torch.sigmoid(gaussians["colour_logits"])
        loss = means.new_zeros(())
        if part.scale_term:
            loss = loss + c.scale_weight * gaussians["log_scales"].exp().mean() / self.scale
        corrected = None if formation is None else formation()
        moments = self._moments(part, corrected)
        displacements = torch.zeros(len(moments.times), len(means), 3)
        log_changes = torch.zeros(len(moments.times), len(means))
        if moments.moving:
            # As in MASIV, the network gets positions without a gradient: errors of the motion change the motion only.
            displacements, log_changes = network.changes(means.detach(), moments.times)
            loss = loss + self._regularization(means.detach(), displacements, moments, pairs, part)
        image_losses = []
        for (frame, observed, drawn_background), k in zip(part.images, moments.of_image, strict=True):
            background = torch.tensor(drawn_background, dtype=torch.float32)
            scales = (gaussians["log_scales"] + log_changes[k]).exp()
            positions = means + displacements[k]
            if corrected is not None:
                positions = corrected.positions(observed.view, positions)
            if observed.camera.shutter.is_instant:
                drawn = render(observed.camera, positions, scales, opacities, colours, background)
            else:
                velocity = velocities(network, means.detach(), float(moments.times[k].detach()), observed.camera)
                if corrected is not None:  # the corrections are an affine map
                    ahead = corrected.positions(observed.view, means + displacements[k] + velocity)
                    velocity = ahead - positions
                drawn = expose(observed.camera, positions, velocity, scales, opacities, colours, background)
            rgb = drawn.rgb
            if corrected is not None:
                rgb = corrected.rgb(observed.view, frame, rgb, drawn.alpha, background)
            image_losses.append(self._image_loss(rgb, drawn.alpha, observed, background))
            loss = loss + image_losses[-1] / part.image_count
            if observed.depth is not None and c.depth_weight > 0:
                depth = drawn.depth if corrected is None else corrected.depth(observed.view, drawn.depth)
                distance = depth_distance(depth, drawn.alpha, observed.depth)
                loss = loss + c.depth_weight * distance / (self.half_extent * part.image_count)
        if part.scale_term and formation is not None and corrected is not None:
            level = torch.stack(image_losses).detach().mean()
            loss = loss + level * formation.prior_weight * corrected.penalty()
        return loss

    def _moments(self, part: Part, corrected: Corrections | None) -> Moments:
        """One moment a frame, or one an image if each camera has its own clock."""
        in_images = [frame for frame, *_ in part.images]
        frames = sorted(set(in_images))
        if corrected is None and not self.time_offsets:
            of_image = [frames.index(frame) for frame in in_images]
            of_frame = {frame: row for row, frame in enumerate(frames)}
            return Moments(torch.tensor(frames) / self.fps, of_image, of_frame, moving=frames[-1] > 0)
        views = [image.view for _, image, _ in part.images]
        of_frame = {frame: in_images.index(frame) for frame in frames}
        times = torch.tensor(in_images) / self.fps
        if self.time_offsets:
            times = times + torch.tensor([self.time_offsets[view] for view in views])
        if corrected is not None:
            times = times + corrected.time_offsets(views)
        return Moments(times, list(range(len(in_images))), of_frame, part.moving)

    def _regularization(
        self,
        means: torch.Tensor,
        displacements: torch.Tensor,
        moments: Moments,
        pairs: Pairs,
        part: Part,
    ) -> torch.Tensor:
        """Strain between neighbours, depth below the ground, distance to the hull of the last frame."""
        c = self.config
        total = means.new_zeros(())
        if part.regularized:
            fraction = len(part.regularized) / part.frame_count
            rows = [moments.of_frame[frame] for frame in part.regularized]
            here = displacements if rows == list(range(len(displacements))) else displacements[rows]
            total = total + fraction * c.rigidity_weight * strain(means, here, *pairs, softening=self.scale)
            if self.ground is not None:
                normal = torch.tensor(self.ground.normal, dtype=torch.float32)
                below = torch.relu(float(self.ground.height) - (means + here) @ normal)
                total = total + fraction * c.ground_weight * below.mean() / self.half_extent
        if part.hull is not None:
            chosen, surface, weight = part.hull
            last = max(moments.of_frame)
            distance = self.hulls[last](means + displacements[moments.of_frame[last]], chosen, surface)
            total = total + weight * distance / self.half_extent
        return total

    def _image_loss(
        self, rgb: torch.Tensor, alpha: torch.Tensor, observed: ObservedImage, background: torch.Tensor
    ) -> torch.Tensor:
        """(1 - l) L1 + l (1 - SSIM) over the background, plus L1 of alpha and mask. Occluded pixels have no error.

        If the mask was estimated from a picture of the empty scene, every other image is compared over that scene.
        """
        c, behind = self.config, observed.background
        if behind is None or float(background[0]) < 0.5:
            target = observed.colour + (1 - observed.mask)[..., None] * background
            rgb = torch.lerp(target, rgb, observed.valid[..., None])
        else:  # the picture as it is, without its mask
            target = behind.picture
            rgb = torch.lerp(target, rgb + (1 - alpha)[..., None] * (behind.empty - background), behind.near[..., None])
        absolute = (rgb - target).abs().mean()
        silhouette = ((alpha - observed.mask) * observed.valid).abs().mean()
        return (1 - c.ssim_weight) * absolute + c.ssim_weight * (1 - ssim(rgb, target)) + c.alpha_weight * silhouette
