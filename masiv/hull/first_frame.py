"""Whether frame 0 of a recording shows an object that can be reconstructed: seconds before hours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from masiv.bounds import Bound
from masiv.errors import InputError, MasivError
from masiv.hull.carve import nearest_to_rays, visual_hull
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.scene.scene import Ground, Scene

_RESOLUTION = 32
_FEWEST_PIXELS = 25
"""Of the largest mask: with fewer, a shape is at most five pixels across, and its outline says little more than where
it is."""
_FULL = 0.98
"""Part of a picture from which on its mask has no outline."""
_BELOW = 0.9
"""Part of the hull below the ground from which on the ground is wrong. A hull reaches below it, where no camera looks
from below, but not by this much."""
FILMED = Bound("longest side", 1e-6, 30, "m", "no lens resolves less, and a blue whale has 30 m")
"""Of an object in a recording."""


def require_first_frame(scene: Scene) -> None:
    """Raises InputError with the first of ``first_frame_problems``."""
    for problem in first_frame_problems(scene):
        raise InputError(f"{scene.path}: {problem}")


def first_frame_problems(scene: Scene) -> list[str]:
    """What makes frame 0 of ``scene`` useless, a sentence each; [] if nothing does."""
    if scene.load_cloud is not None:
        points = scene.cloud(0).points
        return _size_and_ground(scene, points)
    needed = 2 if scene.depth_noise is None else 1
    if len(scene.views) < needed:
        return ["it has one camera and no depth: a shape needs two directions, so add a camera or depth pictures"]
    views = silhouettes(scene, 0)
    shown = [view for view in views if (view.distance < 0).any()]
    if len(shown) < needed:
        return [
            f"frame 0: the object is in the mask of {len(shown)} of {len(views)} views, {needed} must show it: check "
            "the masks of that frame, or begin the recording later"
        ]
    largest = max(int((view.distance < 0).sum()) for view in shown)
    if largest < _FEWEST_PIXELS:
        return [
            f"frame 0: the object has {largest} pixels in its largest mask, a shape needs {_FEWEST_PIXELS} or more: "
            "check the masks, or give pictures in which it is larger"
        ]
    outlined = [view for view in shown if (view.distance < 0).mean() < _FULL]
    if len(outlined) < needed:
        return [
            f"frame 0: the masks of {len(shown) - len(outlined)} of {len(views)} views cover the whole picture, so "
            "they have no outline: check whether they are masks, and which value is the object"
        ]
    for view in _looking_away(outlined):
        return [
            f"{view.camera.name} looks away from the object, which its mask shows: check its pose (axes of OpenGL "
            "or OpenCV, camera to world or its inverse)"
        ]
    try:
        hull = visual_hull(replace(scene, ground=None), 0, resolution=_RESOLUTION)
    except MasivError as error:
        return [str(error).removeprefix(f"frame 0 of {scene.path}: ")]
    return _size_and_ground(scene, hull.points)


def _looking_away(views: list[Silhouette]) -> list[Silhouette]:
    """Those of ``views`` behind which the lines through the middles of the masks meet: less than half of them, and of
    three or more, since the lines of two opposite views meet anywhere."""
    if len(views) < 3:
        return []
    middle = nearest_to_rays(views)
    away = [view for view in views if view.camera.project(middle[None])[1][0] <= 0]
    return away if 2 * len(away) < len(views) else []


def _size_and_ground(scene: Scene, points: np.ndarray) -> list[str]:
    try:
        FILMED.check(float(np.ptp(points, axis=0).max()), "the object at frame 0")
    except InputError as error:
        return [f"{error} (are the poses in metres?)"]
    ground = scene.ground
    below = 0.0 if ground is None else float((points @ ground.normal < ground.height).mean())
    if ground is not None and below > _BELOW:
        return [_below(ground, points, below)]
    return []


def _below(ground: Ground, points: np.ndarray, share: float) -> str:
    heights = points @ ground.normal
    return (
        f"{share:.0%} of the object at frame 0 is below the ground: it is {heights.min():.3g} to {heights.max():.3g} m "
        f"high along the ground's normal, the ground is at {ground.height:.3g} m: correct ground or up_axis in "
        "scene.yaml"
    )
