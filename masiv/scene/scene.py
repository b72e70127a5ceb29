"""Multi-view video of one object: calibrated cameras, frames, masks, gravity and ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from masiv.cores import available_cores
from masiv.errors import InputError
from masiv.memory import return_freed
from masiv.scene.camera import Camera
from masiv.scene.cloud import Cloud
from masiv.scene.depth import DepthNoise
from masiv.scene.frame_cache import Frame, FrameCache

T = TypeVar("T")
MaskedReader = Callable[[int, int, np.ndarray], Frame]
"""(view, frame, mask (H, W) float32) -> the picture with this mask."""


@dataclass(frozen=True)
class Ground:
    """A plane {x : normal·x = height}; the object is on the side of the normal. normal (3,) unit, height [m]."""

    normal: np.ndarray
    height: float


def _unknown_background(view: int) -> np.ndarray | None:
    return None


@dataclass(frozen=True)
class Scene:
    """Multi-view video of one object, in world axes, metres and seconds.

    Frames are 0 … frame_count-1, at the times frame / fps. gravity (3,) [m/s²]; up (3,) unit vector; density [kg/m³].
    ``load(view, frame)`` reads a picture and keeps those that were read last (``FrameCache``); ``frame(view, frame)``
    also checks that this scene contains it. ``background(view)``: picture (H, W, 3) uint8 of the empty scene, or None.
    mask_source: where masks come from, for messages. masks_estimated: from colours, none was given.
    correct_masks: makes the masks of the views of one frame agree, see ``masiv.hull.consistent_masks``; None for masks
    that are given. load_with_mask: as ``load``, with a mask that is known, and mask_inputs: what masks follow from, as
    plain values; both if masks are estimated. hidden_views: cameras that are held out. fit_frames: of scene.yaml, if
    given. problems: sentences for the user. velocities (T, 3) [m/s]: mean velocity of the object at each frame, if a
    stage has estimated it for silhouettes of views that show other times than the frame's. time_offsets [s]: of the
    cameras' clocks, empty if all are exact. A picture was taken at frame / fps + offset. missing: (view, frame) of
    which there is no picture. depth_noise: None if the pictures have no depth. ``load_cloud(frame)``: for a recording
    of point clouds, which has
    no cameras; ``cloud(frame)`` also checks that this scene contains it.
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
    masks_estimated: bool = False
    background: Callable[[int], np.ndarray | None] = _unknown_background
    problems: tuple[str, ...] = ()
    correct_masks: CorrectMasks | None = None
    load_with_mask: MaskedReader | None = None
    mask_inputs: Callable[[], Any] | None = None
    hidden_views: tuple[int, ...] = ()
    fit_frames: int | None = None
    depth_noise: DepthNoise | None = None
    load_cloud: Callable[[int], Cloud] | None = None
    velocities: np.ndarray | None = None
    time_offsets: tuple[float, ...] = ()
    missing: frozenset[tuple[int, int]] = frozenset()

    def __post_init__(self) -> None:
        if not isinstance(self.load, FrameCache):
            object.__setattr__(self, "load", FrameCache(self.load))

    def __getstate__(self) -> dict[str, Any]:
        """Pickled without corrected masks: another process makes those that it needs."""
        return {name: value for name, value in self.__dict__.items() if name != "_corrected"}

    @property
    def times(self) -> np.ndarray:
        """Times of the frames, shape (T,) [s]."""
        return np.arange(self.frame_count) / self.fps

    @property
    def views(self) -> tuple[int, ...]:
        """Indices of the cameras that are not held out."""
        return tuple(v for v in range(len(self.cameras)) if v not in self.hidden_views)

    @property
    def observed_frames(self) -> tuple[int, ...]:
        """Frames of which a camera that is not held out has a picture."""
        if not self.missing:
            return tuple(range(self.frame_count))
        return tuple(k for k in range(self.frame_count) if any((v, k) not in self.missing for v in self.views))

    def time_offset(self, view: int) -> float:
        """Of the clock of ``view`` [s]."""
        return self.time_offsets[view] if self.time_offsets else 0.0

    def shows_other_times(self, view: int) -> bool:
        """Whether pixels of ``view`` show other times than that of their frame: rolling shutter, clock."""
        return self.cameras[view].shutter.readout_time != 0 or self.time_offset(view) != 0

    @property
    def view_time_offsets(self) -> tuple[float, ...]:
        """``time_offsets`` [s] of ``views``; empty if all clocks are exact."""
        return tuple(self.time_offsets[view] for view in self.views) if any(self.time_offsets) else ()

    def frame(self, view: int, frame: int) -> Frame:
        """The picture of ``view`` at ``frame``; ``valid`` is False everywhere if there is none.

        Raises InputError if the frame or the view is held out or does not exist.
        """
        return self._cache(view, frame)(view, frame)

    def mask(self, view: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """``mask`` (H, W) and ``valid`` (H, W) of ``frame(view, frame)``."""
        return self._cache(view, frame).mask(view, frame)

    def _cache(self, view: int, frame: int) -> FrameCache:
        """That of the masks that are used. Raises InputError if the frame is not of this scene."""
        if not 0 <= frame < self.frame_count or view not in self.views:
            raise InputError(f"view {view}, frame {frame} of {self.path} is held out from this stage or does not exist")
        assert isinstance(self.load, FrameCache)
        return self.load if self.correct_masks is None else self._corrected

    def release_pictures(self) -> None:
        """Free the memory of the pictures that were read; those that are needed again are read again."""
        for cache in (self.load, self.__dict__.get("_corrected")):
            if isinstance(cache, FrameCache):
                cache.clear()
        return_freed()

    def map_views(self, frame: int, function: Callable[[int, Frame], T]) -> list[T]:
        """``function(view, picture)`` of each view of ``frame`` that is not held out, in a thread a core."""
        if self.correct_masks is not None and self.views:
            self.frame(self.views[0], frame)  # makes those of all views
        return self._map(lambda view: function(view, self.frame(view, frame)))

    def map_masks(self, frame: int, function: Callable[[int, np.ndarray, np.ndarray], T]) -> list[T]:
        """``function(view, mask, valid)`` as ``map_views``. A mask that was asked for before is not read again, even if
        its picture was dropped."""
        if self.correct_masks is not None and self.views:
            self.mask(self.views[0], frame)  # makes those of all views
        return self._map(lambda view: function(view, *self.mask(view, frame)))

    def _map(self, function: Callable[[int], T]) -> list[T]:
        with ThreadPoolExecutor(available_cores()) as threads:
            return list(threads.map(function, self.views))

    @cached_property
    def _corrected(self) -> FrameCache:
        def corrected(view: int, frame: int) -> Frame:
            assert self.correct_masks is not None
            found = self.correct_masks(replace(self, correct_masks=None), frame)
            for other, picture in found.items():
                cache.put(other, frame, picture)
            return found[view]

        cache = FrameCache(corrected)
        return cache

    def cloud(self, frame: int) -> Cloud:
        """The point cloud of ``frame``. Raises InputError if the frame is held out, or the recording has no clouds."""
        if self.load_cloud is None or not 0 <= frame < self.frame_count:
            raise InputError(f"frame {frame} of {self.path} has no point cloud that this stage may see")
        return self.load_cloud(frame)

    def restricted(self, fit_frames: int | None = None, holdout_cameras: tuple[int, ...] = ()) -> Scene:
        """The first ``fit_frames`` frames (None: all) without ``holdout_cameras``: the training data of a fit.

        Raises InputError if fewer than two frames or no camera are left, or a camera does not exist.
        """
        count = self.frame_count if fit_frames is None else fit_frames
        if not 2 <= count <= self.frame_count:
            raise InputError(
                f"--fit-frames {count}: the scene has {self.frame_count} frames, give 2 to {self.frame_count}"
            )
        if holdout_cameras and not self.cameras:
            raise InputError(f"--holdout-camera {holdout_cameras[0]}: {self.path} has point clouds and no cameras")
        for view in holdout_cameras:
            if not 0 <= view < len(self.cameras):
                raise InputError(f"--holdout-camera {view}: the scene has cameras 0 to {len(self.cameras) - 1}")
        hidden = tuple(sorted({*self.hidden_views, *holdout_cameras}))
        if self.cameras and len(hidden) >= len(self.cameras):
            raise InputError("--holdout-camera leaves no camera to train on")
        return replace(self, frame_count=count, hidden_views=hidden)


CorrectMasks = Callable[[Scene, int], Mapping[int, Frame]]
"""(scene, frame) -> the pictures of the frame by view, with masks that agree with each other."""
