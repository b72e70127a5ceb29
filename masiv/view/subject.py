"""What there is to show of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from masiv.scene.camera import Camera
from masiv.twin import Twin

if TYPE_CHECKING:
    from masiv.splat.gaussians import Gaussians


def _no_picture(view: int, frame: int) -> np.ndarray | None:
    return None


@dataclass(frozen=True)
class Subject:
    """A run, as far as it can be shown. What it does not have is None or empty.

    twin: in the condition that is shown; frames: that are simulated; observed (T, N, 3) [m, world]: particles or
    markers that were observed at the first T frames, NaN if missing; gaussians: at frame 0; cameras: of the scene;
    ``picture(view, frame)``: (H, W, 3) uint8, None if there is none; other: a run whose law can be taken, and its name;
    notes: sentences about what is absent and why.
    """

    title: str
    twin: Twin
    frames: int
    observed: np.ndarray | None = None
    gaussians: Gaussians | None = None
    cameras: tuple[Camera, ...] = ()
    picture: Callable[[int, int], np.ndarray | None] = _no_picture
    other: Twin | None = None
    other_name: str = ""
    notes: tuple[str, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """(frames,) [s]."""
        return np.arange(self.frames) / self.twin.fps

    @property
    def released(self) -> bool:
        """Whether the body is let go from rest: it then has no initial motion to vary."""
        return self.twin.initial_conditions[0].release is not None
