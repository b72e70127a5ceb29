"""``ObservedMotion`` of a filmed or scanned body."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from masiv.errors import MasivError
from masiv.hull.carve import visual_hull
from masiv.identifiability.motion import ObservedMotion, noise_std
from masiv.scene.scene import Scene
from masiv.subsample import evenly_spread

MAX_FRAMES = 16
"""Of which hulls are carved; of a longer recording they are evenly spaced."""
RESOLUTION = 24
SUBPIXEL = 0.1
"""Of a pixel: no centre and no length of an outline is known better."""


def scene_motion(scene: Scene, path: tuple[np.ndarray, np.ndarray] | None = None) -> ObservedMotion | None:
    """The motion of the body of ``scene``; None if it is seen in fewer than three frames.

    path: frames (K,) and the centre (K, 3) [m] in them, if it is known better than by the hulls of a few frames.
    """
    observed = scene.observed_frames
    frames = evenly_spread(observed, MAX_FRAMES)
    found, spacings = {}, []
    volume = None
    for frame in frames:
        if scene.load_cloud is not None:
            found[frame] = scene.cloud(frame).points
            volume = _hull_volume(found[frame]) if volume is None else volume
            continue
        try:
            hull = visual_hull(scene, frame, resolution=RESOLUTION)
        except MasivError:  # the object is not in enough masks, which inspect says
            continue
        found[frame] = hull.points
        spacings.append(hull.spacing)
        volume = hull.volume if volume is None else volume
    kept = [frame for frame, points in found.items() if len(points) > 3]
    if len(kept) < 3:
        return None
    clouds = [found[frame] for frame in kept]
    centre = np.stack([points.mean(axis=0) for points in clouds])
    floor = SUBPIXEL * _pixel(scene, centre)
    centre_std = noise_std(centre, floor)
    if path is not None and set(kept) <= set(path[0].tolist()):
        centre = path[1][np.searchsorted(path[0], kept)]
        centre_std = noise_std(path[1], floor)
    # Axes of the ellipsoid with the same second moments.
    shape = np.stack([2 * np.sqrt(5 * np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0)) for points in clouds])
    lowest, height_std = None, floor
    if scene.ground is not None:
        half = 0.5 * spacings[0] if spacings else 0.0
        lowest = (
            np.array([float((points @ scene.ground.normal).min()) for points in clouds]) - scene.ground.height - half
        )
        # Even in a voxel.
        height_std = max(floor, float(np.median(spacings)) / 12**0.5 if spacings else floor)
    motion = ObservedMotion(
        name=scene.path.name, times=np.array(kept) / scene.fps, centre=centre, centre_std=centre_std,
        shape=shape, shape_std=noise_std(shape, floor), lowest=lowest, height_std=height_std,
        floor=floor,
        size=float(np.ptp(clouds[0], axis=0).max()), mass=None if volume is None else volume * scene.density,
        gravity=scene.gravity, normal=scene.up if scene.ground is None else scene.ground.normal,
    )  # fmt: skip
    return motion.with_flight_noise()


def _hull_volume(points: np.ndarray) -> float | None:
    """Of the convex hull [m³], an upper bound; None if the points are in one plane."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return None


def _pixel(scene: Scene, centre: np.ndarray) -> float:
    """Size [m] of a pixel at the body, the median over the cameras; 0 for point clouds."""
    if not scene.cameras:
        return 1e-4
    sizes = [
        float(np.linalg.norm(centre[0] - scene.cameras[v].centre)) / scene.cameras[v].intrinsics[0, 0]
        for v in scene.views
    ]
    return float(np.median(sizes))
