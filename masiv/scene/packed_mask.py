"""A mask in few bytes: a recording has thousands of them, which several passes need, and few fit into memory."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np

LEVEL = 1
"""Of the compression: the fastest. Most pixels are 0 or 1."""


@dataclass(frozen=True)
class PackedMask:
    """``mask`` (H, W) float32 and ``valid`` (H, W) bool of a picture, without loss.

    box: column, row, width, height of what is not 0 in the mask; mask: compressed pixels of the box; valid: compressed
    bits, None if all are True.
    """

    shape: tuple[int, int]
    box: tuple[int, int, int, int]
    mask: bytes
    valid: bytes | None

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return len(self.mask) + len(self.valid or b"")

    @classmethod
    def of(cls, mask: np.ndarray, valid: np.ndarray) -> PackedMask:
        """Pack ``mask`` (H, W) float32 and ``valid`` (H, W) bool."""
        column, row, width, height = cv2.boundingRect((mask != 0).astype(np.uint8))
        inside = np.ascontiguousarray(mask[row : row + height, column : column + width], np.float32)
        bits = None if valid.all() else zlib.compress(np.packbits(valid).tobytes(), LEVEL)
        shape = mask.shape[0], mask.shape[1]
        return cls(shape, (column, row, width, height), zlib.compress(inside.tobytes(), LEVEL), bits)

    def unpacked(self) -> tuple[np.ndarray, np.ndarray]:
        """``mask`` and ``valid``."""
        column, row, width, height = self.box
        mask = np.zeros(self.shape, np.float32)
        inside = np.frombuffer(zlib.decompress(self.mask), np.float32)
        mask[row : row + height, column : column + width] = inside.reshape(height, width)
        if self.valid is None:
            return mask, np.ones(self.shape, bool)
        bits = np.frombuffer(zlib.decompress(self.valid), np.uint8)
        return mask, np.unpackbits(bits, count=mask.size).reshape(self.shape).astype(bool)
