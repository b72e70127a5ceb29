"""``ObservedMotion`` of a filmed or scanned body."""

from __future__ import annotations

import numpy as np

from masiv.errors import MasivError
from masiv.hull.carve import visual_hull
from masiv.identifiability.motion import ObservedMotion, noise_std
from masiv.scene.scene import Scene

MAX_FRAMES = 16
"""Of which hulls are carved; of a longer recording they are evenly spaced."""
RESOLUTION = 24
SUBPIXEL = 0.1
"""Of a pixel: no centre and no length of an outline is known better."""


def scene_motion(scene: Scene) -> ObservedMotion | None:
    """The motion of the body of ``scene``; None if it is seen in fewer than three frames."""
    observed = scene.observed_frames
    frames = sorted({observed[k] for k in np.linspace(0, len(observed) - 1, MAX_FRAMES).round().astype(int)})
    found, spacings = {}, []
    volume = None
    for frame in frames:
        if scene.load_cloud is not None:
            found[frame] = scene.cloud(frame).points
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
    # Half-axes of the ellipsoid with the same second moments.
    shape = np.stack([np.sqrt(5 * np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0)) for points in clouds])
    floor = SUBPIXEL * _pixel(scene, centre)
    lowest, height_std = None, floor
    if scene.ground is not None:
        half = 0.5 * spacings[0] if spacings else 0.0
        lowest = (
            np.array([float((points @ scene.ground.normal).min()) for points in clouds]) - scene.ground.height - half
        )
        # Even in a voxel.
        height_std = max(floor, float(np.median(spacings)) / 12**0.5 if spacings else floor)
    motion = ObservedMotion(
        name=scene.path.name, times=np.array(kept) / scene.fps, centre=centre, centre_std=noise_std(centre, floor),
        shape=shape, shape_std=noise_std(shape, floor), lowest=lowest, height_std=height_std,
        size=float(np.ptp(clouds[0], axis=0).max()), mass=None if volume is None else volume * scene.density,
        gravity=scene.gravity, normal=scene.up if scene.ground is None else scene.ground.normal,
    )  # fmt: skip
    return motion.with_flight_noise()


def _pixel(scene: Scene, centre: np.ndarray) -> float:
    """Size [m] of a pixel at the body, the median over the cameras; 0 for point clouds."""
    if not scene.cameras:
        return 1e-4
    sizes = [
        float(np.linalg.norm(centre[0] - scene.cameras[v].centre)) / scene.cameras[v].intrinsics[0, 0]
        for v in scene.views
    ]
    return float(np.median(sizes))
