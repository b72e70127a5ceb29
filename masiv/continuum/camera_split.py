"""How far points are from where they were followed: two reconstructions, each from one half of the cameras.

If the errors of the halves are independent and the whole has half of their variance, half the difference of the halves
is as large as the error of the whole. What both halves get wrong alike (a surface that no camera sees, matter that
changes place inside of a body) does not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.continuum.trajectory import positions_at
from masiv.scene.scene import Scene
from masiv.splat.dynamic import DynamicGaussians

MIN_CAMERAS = 6
"""Fewer cannot be split: two silhouettes leave most of a body's shape open."""


@dataclass(frozen=True)
class CameraSplit:
    """The same motion from two disjoint sets of cameras."""

    halves: tuple[DynamicGaussians, DynamicGaussians]

    def tracking_error(self, points: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Half the difference (K, N, 3) [m, world] of the two motions at ``times`` (K,) [s] of what is at ``points``
        (N, 3) [m, world] at frame 0: one draw of the error of following them."""
        first, second = (positions_at(half.deformation, points, times) for half in self.halves)
        return 0.5 * (first.astype(np.float64) - second)


def camera_halves(scene: Scene, centre: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """The cameras of ``scene`` that are not held out, in two sets that both surround the object at ``centre`` (3,) [m,
    world]: neighbours in azimuth about the up axis are in different ones. None if there are fewer than
    ``MIN_CAMERAS``."""
    if len(scene.views) < MIN_CAMERAS:
        return None
    up = np.asarray(scene.up, dtype=np.float64) / np.linalg.norm(scene.up)
    arms = np.stack([scene.cameras[view].centre for view in scene.views]) - centre
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    azimuth = np.arctan2(arms @ np.cross(up, first), arms @ first)
    order = [scene.views[k] for k in np.argsort(azimuth, kind="stable")]
    return tuple(sorted(order[::2])), tuple(sorted(order[1::2]))
