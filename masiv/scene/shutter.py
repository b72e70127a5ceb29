"""When the pixels of a picture are exposed: exposure time and rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    import torch

Rows = TypeVar("Rows", np.ndarray, "torch.Tensor")


@dataclass(frozen=True)
class Shutter:
    """Row by row exposure. The time of a frame is the middle of the exposure of the middle row.

    exposure_time [s] of each row. readout_time [s]: from the first (top) row to the last one; negative if the last row
    is read first. first_row, last_row [pixels]: y of the centres of the sensor's first and last row in this image,
    which can be a crop of the whole picture.
    """

    exposure_time: float = 0.0
    readout_time: float = 0.0
    first_row: float = 0.0
    last_row: float = 1.0

    @classmethod
    def of_image(cls, exposure_time: float, readout_time: float, height: int) -> Shutter:
        """The shutter of a whole picture with ``height`` rows."""
        return cls(exposure_time, readout_time, 0.5, max(height, 2) - 0.5)

    @property
    def is_instant(self) -> bool:
        """Whether all pixels show the same instant."""
        return self.exposure_time == 0 and self.readout_time == 0

    def row_times(self, rows: Rows) -> Rows:
        """Middle of the exposure [s] after the frame's time, at y = ``rows`` [pixels]; outside as at the edge."""
        fraction = (rows - self.first_row) / (self.last_row - self.first_row)
        return self.readout_time * (fraction.clip(0.0, 1.0) - 0.5)

    def cropped(self, y0: float) -> Shutter:
        """The shutter of an image that starts at y = ``y0`` [pixels]."""
        return replace(self, first_row=self.first_row - y0, last_row=self.last_row - y0)

    def reduced(self, factor: float) -> Shutter:
        """The shutter of an image that is averaged down by ``factor``."""
        return replace(self, first_row=self.first_row / factor, last_row=self.last_row / factor)


INSTANT = Shutter()
