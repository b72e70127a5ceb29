"""What is asked of a simulation, and the simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.errors import InputError
from masiv.materials.blend import blend
from masiv.progress import Progress, silent
from masiv.simulation.rollout import Rollout
from masiv.simulation.simulate import simulate
from masiv.twin import Twin

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Variation:
    """velocity [m/s], omega [rad/s], gravity [m/s²], world frame: as identified if None. law: weight of the other
    run's law, from 0 (the run's own) to 1."""

    velocity: Vector | None = None
    omega: Vector | None = None
    gravity: Vector | None = None
    law: float = 0.0


@dataclass(frozen=True)
class Job:
    """What all simulations of a page share. other: whose law can be taken."""

    twin: Twin
    frames: int
    other: Twin | None = None

    def run(self, variation: Variation, progress: Progress = silent) -> Rollout:
        """The rollout of ``variation``, with stress, strain and accelerations. Raises InputError, MasivError."""
        twin = self.twin
        if variation.law:
            if self.other is None:
                raise InputError("there is no other law: name its run with --law")
            twin = twin.with_body(law=blend(twin.law, self.other.law, variation.law))
        return simulate(
            twin,
            frames=self.frames,
            velocity=_vector(variation.velocity),
            omega=_vector(variation.omega),
            gravity=_vector(variation.gravity),
            fields=True,
            progress=progress,
        )


def _vector(value: Vector | None) -> np.ndarray | None:
    return None if value is None else np.array(value, dtype=np.float64)


def can_blend(twin: Twin, other: Twin) -> bool:
    """Whether laws between those of the two twins exist."""
    try:
        blend(twin.law, other.law, 0.5)
    except InputError:
        return False
    return True
