"""Pictures and a video of a simulated motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.progress import Progress, silent
from masiv.report.draw import backdrop, draw
from masiv.report.follow import Binding
from masiv.report.media import write_png, write_video
from masiv.report.viewpoints import Viewpoint
from masiv.scene.camera import Camera
from masiv.scene.scene import Ground

if TYPE_CHECKING:
    from masiv.splat.gaussians import Gaussians

LIGHT, DARK = (0.93, 0.62, 0.25), (0.55, 0.30, 0.12)
"""Colours of the squares on a body that was never seen."""


def film(
    viewpoints: Sequence[Viewpoint],
    gaussians: Gaussians,
    motion: np.ndarray,
    out: Path,
    *,
    up: np.ndarray,
    ground: Ground | None,
    fps: float,
    progress: Progress = silent,
) -> None:
    """Draw ``motion`` (T, Q, 3) [m] into ``out``/views/VIEWPOINT_FRAME.png and ``out``/video.mp4, the viewpoints side
    by side, ``fps`` pictures a second.

    ``gaussians`` are those of frame 0, moved by the particles; the ground is drawn as a chequered plane.
    """
    binding = Binding.at_rest(gaussians, motion[0])
    tile = float(np.ptp(motion[0], axis=0).max()) / 2
    backgrounds: dict[str, tuple[Camera, np.ndarray]] = {}

    def pictures() -> Iterator[np.ndarray]:
        for frame, particles in enumerate(motion):
            now = binding.moved(particles)
            row = []
            for viewpoint in viewpoints:
                camera = viewpoint.cameras[frame]
                known, background = backgrounds.get(viewpoint.name, (None, None))
                if background is None or known is not camera:
                    background = backdrop(camera, up, ground, tile)
                    backgrounds[viewpoint.name] = camera, background
                picture, _ = draw(now, camera, background)
                write_png(out / "views" / f"{viewpoint.name}_{frame:03d}.png", picture)
                row.append(picture)
            yield joined(row)
            progress("render", frame + 1, len(motion))

    write_video(out / "video.mp4", pictures(), fps)


def balls(particles: np.ndarray, volume: float) -> Gaussians:
    """One Gaussian a particle (Q, 3) [m] of a body of ``volume`` [m³] that no camera saw.

    Squares of two colours, so that its turning and stretching show.
    """
    import torch

    from masiv.splat.gaussians import Gaussians

    spacing = (volume / len(particles)) ** (1 / 3)
    low, size = particles.min(0), np.ptp(particles, axis=0).max()
    even = np.floor((particles - low) / (size / 6)).sum(1) % 2 == 0
    colours = np.where(even[:, None], LIGHT, DARK)
    means = torch.as_tensor(particles, dtype=torch.float32)
    flat = torch.full((len(particles),), 0.5 * spacing)
    return Gaussians(means, flat, torch.full_like(flat, 0.95), torch.as_tensor(colours, dtype=torch.float32))


def joined(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures side by side, shorter ones filled up with white below: (H, W, 3) uint8."""
    height = max(picture.shape[0] for picture in pictures)
    filled = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0)), constant_values=255) for p in pictures]
    return np.concatenate(filled, axis=1)
