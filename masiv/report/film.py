"""Pictures and a video of a simulated motion, from the scene's own cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.progress import Progress, silent
from masiv.report.draw import backdrop, draw
from masiv.report.follow import Binding
from masiv.report.media import write_png, write_video
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.splat.dynamic import DynamicGaussians


def film(
    scene: Scene,
    dynamic: DynamicGaussians,
    motion: np.ndarray,
    views: Sequence[int],
    out: Path,
    *,
    progress: Progress = silent,
) -> None:
    """Draw ``motion`` (T, Q, 3) [m] into ``out``/views/VIEW_FRAME.png and ``out``/video.mp4, the views side by side.

    The Gaussians of frame 0 are carried by the particles; the ground is drawn as a chequered plane.
    """
    binding = Binding.at_rest(dynamic.at(0.0), motion[0])
    tile = float(np.ptp(motion[0], axis=0).max()) / 2
    backgrounds = [backdrop(scene.cameras[view], scene.up, scene.ground, tile) for view in views]
    side_by_side = []
    for frame, particles in enumerate(motion):
        gaussians = binding.moved(particles)
        pictures = []
        for view, background in zip(views, backgrounds, strict=True):
            picture, _ = draw(gaussians, scene.cameras[view], background)
            write_png(out / "views" / f"{view}_{frame:03d}.png", picture)
            pictures.append(picture)
        side_by_side.append(joined(pictures))
        progress("render", frame + 1, len(motion))
    write_video(out / "video.mp4", side_by_side, scene.fps)


def joined(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures beside each other, shorter ones filled up with white below: (H, W, 3) uint8."""
    height = max(picture.shape[0] for picture in pictures)
    filled = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0)), constant_values=255) for p in pictures]
    return np.concatenate(filled, axis=1)
