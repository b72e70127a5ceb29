"""Gaussians as a camera with an exposure time and a rolling shutter sees them while they move."""

from __future__ import annotations

import math

import torch

from masiv.scene.camera import Camera
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.rasteriser import Rendering, render

SAMPLE_STEP = 1.0  # pixels
"""Motion between two samples of an exposure, at most, unless ``MAX_SAMPLES`` is reached. Of the error of an image
without blur, 4 % are left with steps of 1 pixel, 27 % with 2 (Gaussians of 0.6 pixels with random colours, motion of 4
pixels, against 128 samples)."""
MAX_SAMPLES = 8
"""Renders of one image, at most: the time of a step grows with them."""


def velocities(network: DeformationNetwork, means: torch.Tensor, time: float, camera: Camera) -> torch.Tensor:
    """Mean velocity (N, 3) [m/s] of Gaussians that are at ``means`` (N, 3) [m] at frame 0, over an image's exposure.

    time [s]: of the image. The motion is known from the first to the last frame only, so the interval ends there.
    """
    shutter = camera.shutter
    half = 0.5 * (shutter.exposure_time + abs(shutter.readout_time))
    end = (network.frame_count - 1) / network.fps
    middle = min(max(0.0, time), end)
    first, last = max(0.0, middle - half), min(end, middle + half)
    moved = network.displacements(means, torch.tensor([first, last]))
    return (moved[1] - moved[0]) / (last - first)


def expose(
    camera: Camera,
    means: torch.Tensor,
    velocity: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colours: torch.Tensor,
    background: torch.Tensor,
) -> Rendering:
    """Of Gaussians that are at ``means`` (N, 3) [m] at the frame's time.

    The mean of renders that are spread over the exposure time. In each of them a Gaussian is where it is when its row
    is read, x + v (t_row + t_sample): ``velocity`` (N, 3) [m/s] is taken as constant over the exposure of one image.
    """
    count = sample_count(camera, means, velocity)
    drawn = []
    for k in range(count):
        sample = camera.shutter.exposure_time * ((k + 0.5) / count - 0.5)
        drawn.append(render(camera, at_row(camera, means, velocity, sample), scales, opacities, colours, background))
    rgb, alpha = (torch.as_tensor(sum(parts)) for parts in ([d.rgb for d in drawn], [d.alpha for d in drawn]))
    depth = torch.as_tensor(sum(one.alpha * one.depth for one in drawn))
    depth = torch.where(alpha > 0, depth / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return Rendering(rgb / count, alpha / count, depth)


def at_row(camera: Camera, means: torch.Tensor, velocity: torch.Tensor, sample: float) -> torch.Tensor:
    """Positions (N, 3) [m] when the row that shows them is exposed, ``sample`` [s] from the middle of its exposure.

    The row depends on the position and the position on the row: two steps of a fixed-point iteration, whose error falls
    by the ratio of the image's motion to the height of the picture in each.
    """
    moved = means + velocity * sample
    if camera.shutter.readout_time != 0:
        for _ in range(2):
            moved = means + velocity * (sample + camera.shutter.row_times(_project(camera, moved)[:, 1]))[:, None]
    return moved


def sample_count(camera: Camera, means: torch.Tensor, velocity: torch.Tensor) -> int:
    """How many renders approximate the exposure: by the motion [pixels] that 95 % of the Gaussians do not exceed."""
    exposure = camera.shutter.exposure_time
    if exposure == 0:
        return 1
    with torch.no_grad():
        motion = _project(camera, means + velocity * exposure) - _project(camera, means)
        longest = float(torch.quantile(motion.norm(dim=1), 0.95))
    return min(MAX_SAMPLES, max(1, math.ceil(longest / SAMPLE_STEP))) if math.isfinite(longest) else 1


def _project(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    """World points (N, 3) [m] -> pixels (N, 2); points behind the camera as if they were just in front of it."""
    pose = torch.as_tensor(camera.world_to_camera[:3], dtype=points.dtype)
    pinhole = torch.as_tensor(camera.intrinsics, dtype=points.dtype)
    in_camera = points @ pose[:, :3].T + pose[:, 3]
    return (in_camera @ pinhole.T)[:, :2] / in_camera[:, 2:].clamp(min=1e-3)
