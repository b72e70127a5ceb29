"""How each camera and each image differs from what was given: pose, focal length, clock, exposure.

The corrections are learnt together with the Gaussians: bundle adjustment (Triggs et al. 2000,
doi:10.1007/3-540-44480-7_21) on the pixels themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from masiv.calibration.gauge import POSE, gauge_free_steps, prior_deviations, scaled_deviations
from masiv.scene.calibration import CameraCorrection
from masiv.scene.camera import Camera
from masiv.splat.config import CalibrationConfig

INDEPENDENT_ERRORS = 50
"""Errors of a picture's pixels that are independent of each other. What is left after a fit are errors of the model
(shape, shading, motion), which are alike over patches of about a seventh of the object's width, and in all frames of a
camera. With all pixels counted as independent the prior had no weight, and cameras circled the object by a degree to
explain shading. The number is an estimate: it was not calibrated."""
EXPOSURE_STEP = 0.02
"""Unit of the exposure's parameters: a change of 2 % of white is as visible as about a pixel of displacement."""


class ImageFormation(torch.nn.Module):
    """Corrections of V cameras and of the exposure of their images at T frames; zero at first.

    The prior is about ``cameras``, which may have been corrected by their silhouettes; its width is what the
    silhouettes still disagree.

    ``pose`` (V, 8) are coordinates in which a step of one moves the object by about a pixel in its picture, or by one
    prior standard deviation. From them a linear map makes rotation about the object's centre, translation, focal length
    and clock. The map leaves out what no picture determines: a rigid motion and scaling of the world, and a common
    delay. What is left displaces the object in all pictures together as little like one of these as it can (least
    squares in pixels, and the prior where pixels do not tell). The mean gain and offset of all images are zero too. All
    parameters are float32.
    """

    linear: torch.Tensor
    rotations: torch.Tensor
    translations: torch.Tensor
    pivots: torch.Tensor
    prior_deviations: torch.Tensor

    def __init__(
        self,
        cameras: Sequence[Camera],
        frame_count: int,
        fps: float,
        config: CalibrationConfig,
        points: np.ndarray,
        velocities: np.ndarray,
        inconsistency: np.ndarray | None = None,
    ) -> None:
        """points (P, 3) [m]: of the object, at all frames; velocities (P, 3) [m/s]: theirs. inconsistency (V,)
        [pixels]: of the silhouettes in ``cameras``, see ``scaled_deviations``."""
        super().__init__()
        self.fps, self.config, self.points = fps, config, points
        self.pivot = points.mean(axis=0)
        # The image loss is a mean absolute error. Of independent Laplacian errors of mean b, -log p is their sum over
        # b: the loss times their number over b. So the prior counts b over that number.
        self.prior_weight = 1 / (INDEPENDENT_ERRORS * len(cameras))
        self.exposure_weight = 1 / frame_count
        poses = np.stack([camera.world_to_camera for camera in cameras])
        deviations = prior_deviations(cameras, self.pivot, fps, config)
        if inconsistency is not None:
            deviations = scaled_deviations(deviations, inconsistency, cameras, self.pivot, points, velocities)
        linear = gauge_free_steps(cameras, self.pivot, points, velocities, deviations)
        self.register_buffer("linear", torch.tensor(linear, dtype=torch.float32), persistent=False)
        self.register_buffer("rotations", torch.tensor(poses[:, :3, :3], dtype=torch.float32), persistent=False)
        self.register_buffer("translations", torch.tensor(poses[:, :3, 3], dtype=torch.float32), persistent=False)
        pivots = poses[:, :3, :3] @ self.pivot + poses[:, :3, 3]
        self.register_buffer("pivots", torch.tensor(pivots, dtype=torch.float32), persistent=False)
        self.register_buffer("prior_deviations", torch.tensor(deviations, dtype=torch.float32), persistent=False)
        self.pose = torch.nn.Parameter(torch.zeros(len(cameras), POSE))
        self.exposure = torch.nn.Parameter(torch.zeros(len(cameras), frame_count, 4))

    def forward(self) -> Corrections:
        """What the parameters say now; evaluate it once for all images of a step."""
        return Corrections(
            self,
            (self.linear @ self.pose.flatten()).view_as(self.pose),
            EXPOSURE_STEP * (self.exposure - self.exposure.mean(dim=(0, 1))),
        )

    def found(self) -> tuple[CameraCorrection, ...]:
        """The corrections of the cameras, without gradients."""
        rows = self().cameras.detach().double().numpy()
        return tuple(CameraCorrection(row[:3], row[3:6], float(row[6]), float(row[7])) for row in rows)


@dataclass(frozen=True)
class Corrections:
    """cameras (V, 8): rotation vector [rad], translation [m], log focal factor, time offset [s].

    exposures (V, T, 4): log gain of red, green and blue, and offset as a fraction of white.
    """

    formation: ImageFormation
    cameras: torch.Tensor
    exposures: torch.Tensor

    def time_offsets(self, views: Sequence[int]) -> torch.Tensor:
        """What the clocks of ``views`` (K) add to the times of their images, (K,) [s]."""
        return self.cameras[list(views), 7]

    def positions(self, view: int, positions: torch.Tensor) -> torch.Tensor:
        """World points (N, 3) [m] -> points (N, 3) that the given camera projects as the corrected one does
        ``positions``.

        A focal factor s is a depth divided by s: pixel and projected radius are those of the longer focal length.
        """
        f, c = self.formation, self.cameras[view]
        rotation, pivot = f.rotations[view], f.pivots[view]
        relative = positions @ rotation.T + (f.translations[view] - pivot)
        moved = rotate(c[:3], relative) + c[3:6]
        depth = relative[:, 2] + pivot[2]
        stretched = (depth + moved[:, 2]) * torch.exp(-c[6]) - depth
        return positions + torch.cat([moved[:, :2], stretched[:, None]], dim=1) @ rotation

    def depth(self, view: int, depth: torch.Tensor) -> torch.Tensor:
        """A rendered depth [m] of ``positions``, as it is before the focal length that stands in it."""
        return depth * torch.exp(self.cameras[view, 6])

    def rgb(
        self, view: int, frame: int, rgb: torch.Tensor, alpha: torch.Tensor, background: torch.Tensor
    ) -> torch.Tensor:
        """A rendering (H, W, 3) over ``background`` (3,) as this image's exposure records it.

        The exposure acts on the object, in proportion to ``alpha`` (H, W). The background is drawn at random.
        """
        e, behind = self.exposures[view, frame], (1 - alpha)[..., None] * background
        return (rgb - behind) * torch.exp(e[:3]) + alpha[..., None] * e[3] + behind

    def penalty(self) -> torch.Tensor:
        """Negative logarithm of the Gaussian prior, a scalar; times ``prior_weight`` and a mean image loss, its term.

        An exposure is of one image and the errors of one image speak of it, so it counts less by the number of frames.
        The prior is of a camera's rotation and translation at its own centre, which a rotation about the object moves.
        """
        f, config = self.formation, self.formation.config
        rotation = self.cameras[:, :3]
        shift = self.cameras[:, 3:6] + torch.linalg.cross(f.pivots, rotation)
        at_camera = torch.cat([rotation, shift, self.cameras[:, 6:]], dim=1)
        gains = (self.exposures[..., :3] / config.log_gain).square().sum()
        offsets = (self.exposures[..., 3] / config.offset).square().sum()
        return 0.5 * ((at_camera / f.prior_deviations).square().sum() + f.exposure_weight * (gains + offsets))


def rotate(vector: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """(R - 1) ``points`` (N, 3), R the rotation by ``vector`` (3,) [rad] (Rodrigues' formula); exact at zero."""
    square = vector.square().sum()
    small = square < 1e-8
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    first = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / angle.square())
    across = torch.linalg.cross(vector.expand_as(points), points)
    return first * across + second * torch.linalg.cross(vector.expand_as(points), across)
