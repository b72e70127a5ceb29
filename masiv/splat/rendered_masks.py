"""Masks of the reconstructed object: what all pictures together say of each pixel.

A mask that was estimated from one picture has the noise of that picture, and holes where the object looks like what is
behind it. The Gaussians are fitted to all pictures, also over the empty scene, where masks play no part. Their rendered
alpha is the share of a pixel that the object covers, consistent over views and frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Scene
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.rasteriser import render
from masiv.splat.shutter import expose, velocities


@dataclass(frozen=True)
class RenderedMasks:
    """``Scene.correct_masks``: replaces the masks of a frame by the alpha of ``dynamic``."""

    dynamic: DynamicGaussians

    def __call__(self, scene: Scene, frame: int) -> dict[int, Frame]:
        """The pictures of ``frame`` in all views of ``scene``, whose cameras are those of ``dynamic``."""
        return {view: self._rendered(scene, view, frame) for view in scene.views}

    def _rendered(self, scene: Scene, view: int, frame: int) -> Frame:
        picture, camera = scene.load(view, frame), scene.cameras[view]
        time = frame / scene.fps + scene.time_offset(view)
        g = self.dynamic.at(time)
        with torch.no_grad():
            if camera.shutter.is_instant:
                drawn = render(camera, g.means, g.scales, g.opacities, g.colours, torch.zeros(3))
            else:
                velocity = velocities(self.dynamic.deformation, self.dynamic.canonical.means, time, camera)
                drawn = expose(camera, g.means, velocity, g.scales, g.opacities, g.colours, torch.zeros(3))
        alpha = np.where(picture.valid, drawn.alpha.numpy(), 0).astype(np.float32)
        return replace(picture, mask=alpha)


def as_reconstructed(scene: Scene, dynamic: DynamicGaussians) -> Scene:
    """``scene`` as later stages see it: with refined cameras, and with rendered masks if masks were estimated."""
    if dynamic.calibration is not None:
        scene = dynamic.calibration.applied_to(scene)
    return replace(scene, correct_masks=RenderedMasks(dynamic)) if scene.masks_estimated else scene
