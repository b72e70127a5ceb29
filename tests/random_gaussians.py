"""Gaussians of random place, size and colour, a camera in front of them, and a number that depends on every pixel."""

from __future__ import annotations

import math

import numpy as np
import torch

from masiv.scene.camera import Camera


def make_camera(width=37, height=29, skew=0.0):
    """Off-centre principal point, unequal focal lengths, a general pose 2 m away from the origin."""
    angle = 0.4
    rotation = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    tilt = np.array([[1, 0, 0], [0, math.cos(0.3), -math.sin(0.3)], [0, math.sin(0.3), math.cos(0.3)]])
    pose = np.eye(4)
    pose[:3, :3] = tilt @ rotation
    pose[:3, 3] = [0.05, -0.1, 2.0]
    intrinsics = np.array([[60.0, skew, 0.45 * width], [0, 55.0, 0.55 * height], [0, 0, 1]])
    return Camera("test", width, height, intrinsics, pose)


def make_gaussians(count=60, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    means = rng.uniform(-0.4, 0.4, (count, 3))
    scales = rng.uniform(0.005, 0.12, count)
    opacities = rng.uniform(0.002, 1.0, count)
    colours = rng.uniform(0, 1, (count, 3))
    return [torch.tensor(a, dtype=dtype, requires_grad=True) for a in (means, scales, opacities, colours)]


BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def weighted(picture, seed=3):
    """A scalar that depends on every pixel of rgb, alpha and depth, with weights of both signs."""
    generator = torch.Generator().manual_seed(seed)
    return sum(
        (p.double() * torch.randn(p.shape, generator=generator, dtype=torch.float64)).sum()
        for p in (picture.rgb, picture.alpha, picture.depth)
    )
