"""Frames that were read, up to a number of bytes; the one that was not used for the longest time is dropped first.
Masks of those that were dropped stay."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from masiv.memory import return_freed
from masiv.scene.packed_mask import PackedMask

MAX_BYTES = 1 << 29
"""Of the frames that one scene keeps [bytes]."""
MAX_BYTES_OF_WORKER = 1 << 27
"""In another process, which is given a scene to compare a few pictures with rollouts [bytes]."""

RETURNED_SHARE = 0.25
"""Memory of dropped frames goes back to the system when it is this share of what is kept: arrays of other sizes leave
gaps between them, which would add up to as much as is kept."""
PACKED_SHARE = 1 / 8
"""Packed masks take at most this share of what frames do. One with the noise of an estimate is not small."""


@dataclass(frozen=True)
class Frame:
    """One picture of one view.

    image (H, W, 3) uint8 RGB; mask (H, W) float32 in [0, 1], 1 on the object; valid (H, W) bool, False if an occluder
    hides the scene or there is no picture. depth (H, W) float32 [m] along the optical axis, 0 where it is unknown;
    None if the recording has none.
    """

    image: np.ndarray
    mask: np.ndarray
    valid: np.ndarray
    depth: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        depth = 0 if self.depth is None else self.depth.nbytes
        return self.image.nbytes + self.mask.nbytes + self.valid.nbytes + depth


class FrameCache:
    """``load(view, frame)``, which reads a ``Frame``, with the frames read last, at most ``max_bytes``, and the masks
    of others, packed. Threads may share it."""

    def __init__(self, load: Callable[[int, int], Frame], max_bytes: int = MAX_BYTES) -> None:
        self.load = load
        self.max_bytes = max_bytes
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._packed: dict[tuple[int, int], PackedMask] = {}
        self._bytes, self._dropped, self._packed_bytes = 0, 0, 0
        self._full = False  # until the first frame is dropped, masks need not be packed
        self._lock = threading.Lock()

    def __call__(self, view: int, frame: int) -> Frame:
        """The frame, read again if it was dropped."""
        key = view, frame
        with self._lock:
            if key in self._frames:
                self._frames.move_to_end(key)
                return self._frames[key]
        found = self.load(view, frame)
        self.put(view, frame, found)
        return found

    def mask(self, view: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """``mask`` and ``valid`` of a frame, which is read only if it has not been before."""
        key = view, frame
        with self._lock:
            packed = None if key in self._frames else self._packed.get(key)
        if packed is not None:
            return packed.unpacked()
        found = self(view, frame)
        if self._full and self._packed_bytes < self.max_bytes * PACKED_SHARE and key not in self._packed:
            packed = PackedMask.of(found.mask, found.valid)
            with self._lock:
                self._packed[key] = packed
                self._packed_bytes += packed.nbytes
        return found.mask, found.valid

    def put(self, view: int, frame: int, found: Frame) -> None:
        """Keep a frame that was read otherwise."""
        with self._lock:
            self._bytes -= self._frames[view, frame].nbytes if (view, frame) in self._frames else 0
            self._frames[view, frame] = found
            self._bytes += found.nbytes
            while self._bytes > self.max_bytes and len(self._frames) > 1:
                self._full = True
                _, oldest = self._frames.popitem(last=False)
                self._bytes -= oldest.nbytes
                self._dropped += oldest.nbytes
            if self._dropped > self.max_bytes * RETURNED_SHARE:
                self._dropped = 0
                return_freed()

    def clear(self) -> None:
        """Keep no frame; masks stay, which are small."""
        with self._lock:
            self._frames.clear()
            self._bytes = 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without its frames and masks: another process reads those that it needs, and keeps fewer."""
        return FrameCache, (self.load, min(self.max_bytes, MAX_BYTES_OF_WORKER))
