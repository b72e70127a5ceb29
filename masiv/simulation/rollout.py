"""The result of a simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from masiv.files import write_npz
from masiv.simulation.particle_fields import ParticleFields


@dataclass(frozen=True)
class Rollout:
    """positions (T, Q, 3) float32 [m, world] of particles at times (T,) [s]; markers (T, M, 3) float64 [m, world] and
    their names, if the bodies have any. A rigid body is one particle and one marker of its name. fields: stress, strain
    and accelerations of the particles, if they were asked for."""

    positions: np.ndarray
    times: np.ndarray
    markers: np.ndarray | None = None
    marker_names: tuple[str, ...] = ()
    fields: ParticleFields | None = None

    def save(self, path: Path) -> None:
        """Write ``path`` (.npz) without the fields, complete or not at all."""
        arrays: dict[str, Any] = {"positions": self.positions, "times": self.times}
        if self.markers is not None:
            arrays |= {"markers": self.markers, "marker_names": np.array(self.marker_names)}
        write_npz(path, **arrays)
