"""What is on the page now: a motion, and how it is drawn. Knows no widget."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from masiv.report.follow import Binding
from masiv.simulation.rollout import Rollout
from masiv.splat.gaussians import Gaussians
from masiv.view.colours import coloured, field_range
from masiv.view.subject import Subject

SIMULATED, OBSERVED = (230, 120, 30), (40, 110, 200)
PLAIN, STRESS, STRAIN = "one colour", "von Mises stress", "elastic strain"
UNITS = {STRESS: "Pa", STRAIN: "1"}
MAX_PATHS = 40
"""Particles whose way is drawn."""
MAX_ARROWS = 150
"""Particles at which an effect is drawn."""
LONGEST_ARROW = 0.35
"""In sizes of the body."""
SHORTEST_ARROW = 0.02
"""Of the longest one; shorter ones are left out."""
MIN_BOUND = 4
"""Particles that Gaussians need to follow them."""


@dataclass(frozen=True)
class Shown:
    """A simulated motion of ``subject``."""

    subject: Subject
    rollout: Rollout

    @property
    def positions(self) -> np.ndarray:
        """(T, Q, 3) float32 [m, world]."""
        return self.rollout.positions

    @cached_property
    def size(self) -> float:
        """Of the body at frame 0, or of the flight of points [m]."""
        return extent(self.positions[:1] if not self.subject.twin.rigid else self.positions)

    @property
    def particle_spacing(self) -> float:
        """[m]; of points in flight, a fiftieth of their flight, so that they can be seen."""
        twin = self.subject.twin
        if twin.rigid:
            return 0.02 * self.size
        return (twin.volume / self.positions.shape[1]) ** (1 / 3)

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """What particles can be coloured by: (T, Q), by name."""
        found = self.rollout.fields
        named = {} if found is None else {STRESS: found.stress, STRAIN: found.strain}
        return {name: values for name, values in named.items() if values is not None}

    def top(self, field: str) -> float:
        """Upper end of the range of ``field``; 1 for none."""
        return field_range(self.fields[field]) if field in self.fields else 1.0

    def colours(self, field: str, frame: int, top: float) -> np.ndarray:
        """(Q, 3) uint8."""
        if field not in self.fields:
            return np.tile(np.array(SIMULATED, np.uint8), (self.positions.shape[1], 1))
        return coloured(self.fields[field][frame], top)

    @cached_property
    def binding(self) -> Binding | None:
        """Of the Gaussians to the particles; None if there are no Gaussians, or too few particles."""
        if self.subject.gaussians is None or self.positions.shape[1] < MIN_BOUND:
            return None
        return Binding.at_rest(self.subject.gaussians, self.positions[0])

    def gaussians(self, frame: int) -> Gaussians | None:
        return None if self.binding is None else self.binding.moved(self.positions[frame])

    @cached_property
    def paths(self) -> np.ndarray:
        """Ways of some particles as segments (S, 2, 3) [m]."""
        return segments(self.positions)

    @property
    def accelerations(self) -> dict[str, np.ndarray]:
        """(T, Q, 3) [m/s², world] by name of the effect."""
        return {} if self.rollout.fields is None else self.rollout.fields.accelerations

    def strongest(self, effect: str) -> float:
        """Largest acceleration [m/s²] that ``effect`` gives to a particle that is drawn."""
        given = self.accelerations[effect]
        return float(np.linalg.norm(given[:, spread(given.shape[1], MAX_ARROWS)], axis=-1).max())

    def arrows(self, effect: str, frame: int) -> np.ndarray:
        """Begin and end (M, 2, 3) [m] of the arrows of ``effect`` at ``frame``; the longest of the motion has
        ``LONGEST_ARROW``."""
        strongest = self.strongest(effect)
        chosen = spread(self.positions.shape[1], MAX_ARROWS)
        given = self.accelerations[effect][frame, chosen].astype(np.float64)
        drawn = np.linalg.norm(given, axis=1) > SHORTEST_ARROW * strongest
        begin = self.positions[frame, chosen][drawn].astype(np.float64)
        return np.stack([begin, begin + given[drawn] * (LONGEST_ARROW * self.size / max(strongest, 1e-12))], axis=1)


def extent(positions: np.ndarray) -> float:
    """Longest side [m] of the box around ``positions`` (T, Q, 3), missing ones (NaN) left out."""
    return float(max((np.nanmax(positions, (0, 1)) - np.nanmin(positions, (0, 1))).max(), 1e-6))


def spread(count: int, most: int) -> np.ndarray:
    """Indices of at most ``most`` of ``count``, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def segments(positions: np.ndarray) -> np.ndarray:
    """Ways of some of the points (T, N, 3) as segments (S, 2, 3); those with a missing end are left out."""
    chosen = positions[:, spread(positions.shape[1], MAX_PATHS)]
    pairs = np.stack([chosen[:-1], chosen[1:]], axis=2).reshape(-1, 2, 3)
    return pairs[np.isfinite(pairs).all((1, 2))].astype(np.float32)
