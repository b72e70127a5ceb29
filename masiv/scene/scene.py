"""What was observed: calibrated cameras, frames, and the world around the object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.scene.camera import Camera


@dataclass(frozen=True)
class Ground:
    """A plane {x : normal·x = height}; the object is on the side of the normal. normal (3,) unit, height [m]."""

    normal: np.ndarray
    height: float


@dataclass(frozen=True)
class Frame:
    """One picture: image (H, W, 3) uint8 RGB, mask (H, W) float32 in [0, 1], 1 on the object,
    valid (H, W) bool, False where an occluder hides the scene."""

    image: np.ndarray
    mask: np.ndarray
    valid: np.ndarray


def _unknown_background(view: int) -> np.ndarray | None:
    return None


@dataclass(frozen=True)
class Scene:
    """Multi-view video of one object. World axes, metres, seconds.

    ``background(view)`` is the picture (H, W, 3) uint8 of the empty scene, or None.
    ``load(view, frame)`` reads a picture; use ``frame(view, frame)``, which caches and checks the bounds.
    Frames are integers 0…frame_count-1; times follow as frame / fps. ``fit_frames`` is what scene.yaml
    asks for, if anything. A missing picture has ``valid`` False everywhere.
    """

    path: Path
    layout: str
    fps: float
    frame_count: int
    cameras: tuple[Camera, ...]
    gravity: np.ndarray
    up: np.ndarray
    ground: Ground | None
    density: float
    load: Callable[[int, int], Frame]
    mask_source: str
    background: Callable[[int], np.ndarray | None] = _unknown_background
    problems: tuple[str, ...] = ()
    hidden_views: tuple[int, ...] = ()
    fit_frames: int | None = None
    _cache: dict = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict:
        """Without the pictures that were read: another process reads those that it needs."""
        return {**self.__dict__, "_cache": {}}

    @property
    def times(self) -> np.ndarray:
        """Times of the frames, shape (T,) [s]."""
        return np.arange(self.frame_count) / self.fps

    @property
    def views(self) -> tuple[int, ...]:
        """Indices of the cameras that may be looked at."""
        return tuple(v for v in range(len(self.cameras)) if v not in self.hidden_views)

    def frame(self, view: int, frame: int) -> Frame:
        """The picture of ``view`` at ``frame``. Raises InputError outside of what this scene may see."""
        if not 0 <= frame < self.frame_count or view not in self.views:
            raise InputError(f"view {view}, frame {frame} of {self.path} is outside of what this stage may see")
        key = (view, frame)
        if key not in self._cache:
            self._cache[key] = self.load(view, frame)
        return self._cache[key]

    def restricted(self, fit_frames: int | None = None, holdout_cameras: tuple[int, ...] = ()) -> Scene:
        """The part of the scene that a fit may see: the first ``fit_frames`` frames, without the held-out cameras."""
        count = self.frame_count if fit_frames is None else fit_frames
        if not 2 <= count <= self.frame_count:
            raise InputError(
                f"--fit-frames {count}: the scene has {self.frame_count} frames, give 2 to {self.frame_count}"
            )
        for view in holdout_cameras:
            if not 0 <= view < len(self.cameras):
                raise InputError(f"--holdout-camera {view}: the scene has cameras 0 to {len(self.cameras) - 1}")
        hidden = tuple(sorted({*self.hidden_views, *holdout_cameras}))
        if len(hidden) >= len(self.cameras):
            raise InputError("--holdout-camera leaves no camera to train on")
        return replace(self, frame_count=count, hidden_views=hidden)
