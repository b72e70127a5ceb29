"""Terms of the loss of a continuum's motion: silhouettes, ground, smoothness, volume and rigidity."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import cv2
import numpy as np
import torch

from masiv.array_file import ArrayFile
from masiv.hull.silhouette import PIXELS_A_VOXEL, silhouettes
from masiv.scene.scene import Ground, Scene
from masiv.scene.shutter import INSTANT, Shutter

_LARGEST_SIDE = 256
"""Pixels along the longer side of a distance field. Larger ones are reduced: signed distances are smooth."""
_NOTHING = torch.zeros(0, 0)


@dataclass(frozen=True)
class View:
    """One mask as tensors: signed distance (H, W) [pixels] to its edge, pose (3, 4) [m] and pinhole (3, 3) [pixels].

    velocity (3,) [m/s] of the object, if rows show other times than the frame's: ``shutter``, time_offset [s].
    """

    distance: torch.Tensor
    pose: torch.Tensor
    pinhole: torch.Tensor
    shutter: Shutter = INSTANT
    velocity: torch.Tensor | None = None
    time_offset: float = 0.0


class StoredViews(Sequence[View]):
    """The masks of one frame. Their distances are in a file, and are read when a view is asked for."""

    def __init__(self, file: ArrayFile, views: Iterable[View]) -> None:
        self._file = file
        self._views = [(replace(view, distance=_NOTHING), file.append(view.distance.numpy())) for view in views]

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, index: int) -> View: ...
    @overload
    def __getitem__(self, index: slice) -> list[View]: ...
    def __getitem__(self, index: int | slice) -> View | list[View]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        view, stored = self._views[index]
        return replace(view, distance=torch.from_numpy(self._file.read(stored)))


def load_views(scene: Scene, first: int = 0) -> list[StoredViews]:
    """The masks of all views that are not held out, of each frame from ``first`` on. They are in one file."""
    file, resolution = ArrayFile(), _LARGEST_SIDE // PIXELS_A_VOXEL
    return [
        StoredViews(file, (_view(s) for s in silhouettes(scene, frame, resolution)))
        for frame in range(first, scene.frame_count)
    ]


def _view(silhouette) -> View:
    # The mask says nothing about pixels that an occluder hides.
    distance = np.where(silhouette.valid, silhouette.distance, np.minimum(silhouette.distance, 0.0)).astype(np.float32)
    height, width = distance.shape
    factor = math.ceil(max(height, width) / _LARGEST_SIDE)
    pinhole = silhouette.camera.intrinsics.copy()
    if factor > 1:
        rows, columns = height // factor, width // factor
        distance = cv2.resize(distance, (columns, rows), interpolation=cv2.INTER_AREA) * (columns / width)
        pinhole[0] *= columns / width
        pinhole[1] *= rows / height
    pose = torch.as_tensor(silhouette.camera.world_to_camera[:3], dtype=torch.float32)
    velocity = None if silhouette.velocity is None else torch.as_tensor(silhouette.velocity, dtype=torch.float32)
    shutter = silhouette.camera.shutter.reduced(height / distance.shape[0])
    pinhole = torch.as_tensor(pinhole, dtype=torch.float32)
    return View(torch.as_tensor(distance), pose, pinhole, shutter, velocity, silhouette.time_offset)


def outside_of_mask(positions: torch.Tensor, view: View) -> torch.Tensor:
    """World points (N, 3) [m] -> distance outside of the mask (N,) [m], 0 inside of it or outside of the image."""
    in_camera, depth, pixels = _project(positions, view)
    if view.velocity is not None:
        for _ in range(2):
            read = view.time_offset + view.shutter.row_times(pixels.detach()[:, 1])
            in_camera, depth, pixels = _project(positions + read[:, None] * view.velocity, view)
    size = pixels.new_tensor([view.distance.shape[1], view.distance.shape[0]])
    grid = 2 * pixels / size - 1
    distance = torch.nn.functional.grid_sample(
        view.distance[None, None], grid[None, None], align_corners=False, padding_mode="border"
    )[0, 0, 0]
    shown = (grid.detach().abs() < 1).all(dim=1) & (in_camera.detach()[:, 2] > 1e-3)
    return torch.where(shown, distance.clamp(min=0) * depth / view.pinhole[0, 0], 0.0)


def _project(positions: torch.Tensor, view: View) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """World points (N, 3) [m] -> in the camera's axes (N, 3) [m], depths (N,) [m] and pixels (N, 2)."""
    in_camera = positions @ view.pose[:, :3].T + view.pose[:, 3]
    depth = in_camera[:, 2].clamp(min=1e-3)
    return in_camera, depth, (in_camera @ view.pinhole.T)[:, :2] / depth[:, None]


def below_ground(positions: torch.Tensor, ground: Ground) -> torch.Tensor:
    """World points (..., 3) [m] -> depth below the plane (...) [m], 0 above it."""
    normal = torch.as_tensor(ground.normal, dtype=positions.dtype)
    return (ground.height - positions @ normal).clamp(min=0)


def stencil(centres: torch.Tensor, step: float) -> torch.Tensor:
    """Points (N, 3) -> (7 N, 3): each centre, then its neighbours at ±``step`` along x, y, z."""
    offsets = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(centres) * step
    return (centres[None] + offsets[:, None]).reshape(-1, 3)


def field_terms(displacements: torch.Tensor, step: float) -> dict[str, torch.Tensor]:
    """Displacements (T, 7 N, 3) [m] on a ``stencil`` -> smoothness, volume, rigidity.

    Means over the stencils, dimensionless. F = I + ∂d/∂x by central differences. volume: (det F - 1)². rigidity:
    |FᵀF - I|². smoothness: squared second differences over ``step`` [m].
    """
    d = displacements.reshape(len(displacements), 7, -1, 3)
    middle, ahead, behind = d[:, :1], d[:, 1:4], d[:, 4:7]
    columns = (ahead - behind) / (2 * step)
    gradient = torch.eye(3).to(d) + columns.permute(0, 2, 3, 1)
    strain = gradient.mT @ gradient - torch.eye(3).to(d)
    return {
        "smoothness": ((ahead + behind - 2 * middle) / step).square().sum(-1).mean(),
        "volume": (torch.linalg.det(gradient) - 1).square().mean(),
        "rigidity": strain.square().sum((-1, -2)).mean(),
    }
