"""Paths of a body's particles that were followed in a video."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from masiv.observations.base import Observation
from masiv.scene.transforms import SimulationFrame


@dataclass(frozen=True, kw_only=True)
class VideoObservation(Observation):
    """Particles at ``samples_per_frame`` instants a frame, frame 0 left out; simulation axes, float32."""

    samples_per_frame: int
    simulation_axes: SimulationFrame

    @property
    def points_in_world(self) -> np.ndarray:
        """See ``Observation``."""
        return self.simulation_axes.points_to_world(self.points)

    @property
    def values_in_world(self) -> np.ndarray:
        """See ``Observation``; float64."""
        return self.simulation_axes.points_to_world(self.values.astype(np.float64))

    def field_in_world(self, field: np.ndarray) -> np.ndarray:
        """See ``Observation``."""
        return self.simulation_axes.vectors_to_world(field)

    @property
    def frame_count(self) -> int:
        """Frames after frame 0."""
        return self.time_count // self.samples_per_frame

    @property
    def fit_frames(self) -> int:
        """Frames after frame 0 that are fitted."""
        return self.fit_count // self.samples_per_frame

    def with_fit_frames(self, count: int) -> VideoObservation:
        """The same with ``count`` fitted frames after frame 0."""
        return replace(self, fit_count=count * self.samples_per_frame)

    def seen_at_frames(self) -> np.ndarray:
        """Where the particles were in frame 0 and the fitted frames (1 + fit_frames, N, 3) [m, simulation axes]."""
        later = self.values[self.samples_per_frame - 1 : self.fit_count : self.samples_per_frame]
        return np.concatenate([self.points[None].astype(self.values.dtype), later])
