"""The motion of one body as a recording shows it, whether it was filmed, scanned or tracked by markers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

THIRD_DIFFERENCE = 20.0
"""Variance of the third difference of independent noise of variance 1: 1 + 9 + 9 + 1. Acceleration that is constant
leaves nothing of it."""
NEAR_GROUND = 0.03
"""Of the body's size: outlines and the height of a real floor are not known better (chosen)."""

FLIGHT_FRAMES = 3  # from which a standard deviation is taken
FALL_FRAMES = 5  # … that of a parabola, with two degrees of freedom an axis


@dataclass(frozen=True)
class ObservedMotion:
    """Of one body at T ascending ``times`` [s].

    centre (T, 3) [m, world], axes that were not measured are 0. centre_std, shape_std, height_std [m]: noise of a value
    at one time. shape (T, K) [m]: lengths that a rigid motion leaves as they are (of a clamped body: distances from
    rest), K = 0 if the recording shows none. lowest (T,) [m]: height of the lowest point above the ground, None without
    ground. size [m]; mass [kg] or None; gravity (3,) [m/s²]; normal (3,): of the ground, or up. clamped: held, does not
    fly. medium_density [kg/m³]. floor [m]: no length is known better.
    """

    name: str
    times: np.ndarray
    centre: np.ndarray
    centre_std: float
    shape: np.ndarray
    shape_std: float
    lowest: np.ndarray | None
    height_std: float
    size: float
    mass: float | None
    gravity: np.ndarray
    normal: np.ndarray
    clamped: bool = False
    medium_density: float = 1.2
    floor: float = 0.0

    @property
    def contact(self) -> int | None:
        """The first frame near the ground; None if there is none, or no ground."""
        if self.lowest is None:
            return None
        near = np.flatnonzero(self.lowest < NEAR_GROUND * self.size + self.height_std)
        return int(near[0]) if len(near) else None

    @property
    def flight(self) -> slice:
        """Frames before the contact; none of a clamped body."""
        if self.clamped:
            return slice(0, 0)
        return slice(0, len(self.times) if self.contact is None else self.contact)

    @property
    def deformation(self) -> np.ndarray:
        """How far (T,) [m] the length that changes most is from its value in flight (at the first time without one)."""
        if not self.shape.shape[1]:
            return np.zeros(len(self.times))
        free = self.flight
        rest = np.median(self.shape[free], axis=0) if free.stop > 0 else 0 * self.shape[0]
        if free.stop == 0 and not self.clamped:
            rest = self.shape[0]
        off = self.shape - rest
        return np.abs(off[:, np.argmax(np.abs(off).max(axis=0))])

    def with_flight_noise(self) -> ObservedMotion:
        """With the noise that the flight shows, in which a body keeps its shape, if that is larger (hulls depend on how
        the body is turned), and what its parabola leaves of ``centre``."""
        shape_std, centre_std = self.shape_std, self.centre_std
        free = self.flight
        if free.stop >= FLIGHT_FRAMES and self.shape.shape[1]:
            shape_std = max(shape_std, float(np.sqrt(self.shape[free].var(axis=0, ddof=1).max())))
        if free.stop >= FALL_FRAMES:
            centre_std = max(self.floor, acceleration(self.times[free], self.centre[free])[2])
        return replace(self, shape_std=shape_std, centre_std=centre_std)


def acceleration(times: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Acceleration (3,) [m/s²] of ``path`` (T, 3) [m], T > 3, by least squares, its standard error in one axis, and the
    standard deviation [m] of what is left."""
    t = times - times.mean()
    basis = np.stack([np.ones_like(t), t, 0.5 * t**2], axis=1)
    found, *_ = np.linalg.lstsq(basis, path, rcond=None)
    variance = float(((path - basis @ found) ** 2).sum()) / (3 * (len(t) - 3))
    return found[2], float(np.sqrt(variance * np.linalg.inv(basis.T @ basis)[2, 2])), float(np.sqrt(variance))


def noise_std(values: np.ndarray, floor: float) -> float:
    """Standard deviation [m] of independent noise of (T, K) values at even times, from their third differences; robust
    against a few impacts. At least ``floor``."""
    if len(values) < 6 or not values.shape[1]:
        return floor
    third = np.diff(values, n=3, axis=0)
    return max(floor, 1.4826 * float(np.median(np.abs(third))) / THIRD_DIFFERENCE**0.5)
