"""What was measured: points on bodies over time. Light: no torch, no taichi."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.scene.scene import Ground
from masiv.tracks.geometry import Geometry
from masiv.tracks.placement import Placement

MIN_SEEN_SHARE, MIN_SEEN_FRAMES = 0.5, 6
"""Of the frames after a release, those that must show all markers."""


@dataclass(frozen=True)
class Clamp:
    """What is held: {x : normals x ≤ heights}, in the body's own axes: normals (P, 3) unit, heights (P,) [m].
    ``markers``: those fixed to the clamp. prescribed: it moves with them (``masiv.tracks.prescribed_motion``)."""

    normals: np.ndarray
    heights: np.ndarray
    markers: tuple[str, ...]
    prescribed: bool = False

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which points (..., 3) [m, own axes] are inside, bool (...)."""
        return (points @ self.normals.T <= self.heights).all(axis=-1)


@dataclass(frozen=True)
class TrackedBody:
    """One object; what is None is not known. density [kg/m³]; mass [kg]; bodies of one ``group`` share the laws of
    their surroundings. Where ``geometry`` and one of density and mass are known, so is the other."""

    name: str
    group: str
    geometry: Geometry | None
    density: float | None
    mass: float | None
    poissons_ratio: float | None
    clamps: tuple[Clamp, ...] = ()

    @property
    def held_markers(self) -> tuple[str, ...]:
        """Those fixed to a clamp."""
        return tuple(marker for clamp in self.clamps for marker in clamp.markers)

    def free_markers(self, run: Run) -> tuple[int, ...]:
        """Markers of ``run`` that are not fixed to a clamp and are known at rest in all three axes."""
        held = self.held_markers
        return tuple(m for m, name in enumerate(run.markers) if name not in held and np.isfinite(run.at_rest[m]).all())


@dataclass(frozen=True)
class Run:
    """One recording of one body. World axes, metres, seconds.

    positions (T, M, 3), NaN where nothing was measured; times (T,) as in the file, increasing; rate [Hz]; purpose: fit,
    hold_out or test; rest: frames at rest before the release; at_rest (M, 3): where markers are then (in the first
    frame that shows them, without rest frames), NaN for what was not measured; noise_std (M, 3): standard deviation of
    each axis at rest (None: without two rest frames); release [s]: when the body is let go (None: not known);
    placement: the body's own axes -> world at rest (None: no geometry); ignore_after_release [s]: not
    compared for this long; held_straight: the body has its rest shape before the release.
    """

    name: str
    body: str
    condition: str
    purpose: str
    markers: tuple[str, ...]
    times: np.ndarray
    positions: np.ndarray
    rate: float
    rest: slice | None
    at_rest: np.ndarray
    noise_std: np.ndarray | None
    release: float | None
    placement: Placement | None
    ignore_after_release: float = 0.0
    held_straight: bool = True

    @property
    def axes(self) -> np.ndarray:
        """Which axes of which marker were measured in any frame, (M, 3) bool."""
        return np.asarray(np.isfinite(self.positions).any(axis=0))

    @property
    def seen(self) -> np.ndarray:
        """Frames where a marker has all of its axes, (T, M) bool."""
        return np.asarray((np.isfinite(self.positions) | ~self.axes).all(axis=2) & self.axes.any(axis=1))

    def between(self, start: float, stop: float) -> Run:
        """The frames from ``start`` to ``stop`` [s]; what is known of rest and release stays."""
        inside = np.flatnonzero((self.times >= start) & (self.times <= stop))
        if len(inside) < 2:
            raise InputError(f"run {self.name} has fewer than two frames from {start:g} to {stop:g} s: widen them")
        first, last = int(inside[0]), int(inside[-1]) + 1
        rest = None
        if self.rest is not None and min(self.rest.stop, last) > max(self.rest.start, first):
            rest = slice(max(self.rest.start, first) - first, min(self.rest.stop, last) - first)
        return replace(self, times=self.times[first:last], positions=self.positions[first:last], rest=rest)

    def released(self, markers: Sequence[int], skip: float, duration: float) -> tuple[np.ndarray, np.ndarray, float]:
        """The motion of ``markers`` from ``skip`` to ``duration`` [s] after the release, in frames that show them all.

        Times (K,) [s since the release], positions (K, M, 3) [m, world] and the greatest speed [m/s]. Raises InputError
        if the release is not known or too few frames are left.
        """
        if not skip < duration:
            raise InputError(
                f"run {self.name}: ignore_after_release: {skip:g} s leaves nothing of tracks.duration {duration:g} s"
            )
        if self.release is None:
            raise InputError(f"run {self.name}: nobody knows when it was let go: give rest_frames")
        cut, chosen = self.between(self.release + skip, self.release + duration), list(markers)
        whole = np.asarray(np.isfinite(cut.positions[:, chosen]).all(axis=(1, 2)), bool)
        if whole.mean() < MIN_SEEN_SHARE or whole.sum() < MIN_SEEN_FRAMES:
            names = ", ".join(self.markers[m] for m in chosen)
            raise InputError(
                f"run {self.name}: all of {names} are seen in {int(whole.sum())} of {len(whole)} frames: leave out "
                "with markers those that are rarely seen"
            )
        positions, times = cut.positions[whole][:, chosen], cut.elapsed[whole]
        speed = float(np.linalg.norm(np.diff(positions, axis=0), axis=2).max() / np.diff(times).min())
        return times, positions, speed

    def moving(self) -> Run:
        """The frames from the release on; all of them where it is not known."""
        return self if self.release is None else self.between(self.release, np.inf)

    @property
    def elapsed(self) -> np.ndarray:
        """Times (T,) [s] since the release, or since the first frame where it is not known."""
        return self.times - (self.times[0] if self.release is None else self.release)

    def marker(self, name: str) -> int:
        """The index of a marker. Raises InputError for an unknown one."""
        if name not in self.markers:
            raise InputError(f"run {self.name} has no marker '{name}': it has {', '.join(self.markers)}")
        return self.markers.index(name)


@dataclass(frozen=True)
class Tracks:
    """A scene of measured points. up (3,) unit; gravity (3,) [m/s²]; ground: the plane, or None; medium_density
    [kg/m³] and medium_viscosity [Pa s]: of what the bodies move through."""

    path: Path
    up: np.ndarray
    gravity: np.ndarray
    ground: Ground | None
    bodies: dict[str, TrackedBody]
    runs: tuple[Run, ...]
    problems: tuple[str, ...] = ()
    medium_density: float = 1.2
    medium_viscosity: float = 1.8e-5

    layout = "tracks"

    def chosen(self, purpose: str, *, body: str | None = None, condition: str | None = None) -> tuple[Run, ...]:
        """Runs by purpose (fit, hold_out, test) and, where given, by body and condition."""
        return tuple(
            run
            for run in self.runs
            if run.purpose == purpose and body in (None, run.body) and condition in (None, run.condition)
        )

    def groups(self) -> dict[str, tuple[TrackedBody, ...]]:
        """Bodies by the group in which they share the laws of their surroundings."""
        names = dict.fromkeys(body.group for body in self.bodies.values())
        return {name: tuple(b for b in self.bodies.values() if b.group == name) for name in names}


def rest_positions(positions: np.ndarray, rest: slice | None) -> tuple[np.ndarray, np.ndarray | None]:
    """``at_rest`` and ``noise_std`` of a ``Run`` with positions (T, M, 3) [m]."""
    if rest is None:
        first = np.argmax(np.isfinite(positions), axis=0)
        return np.take_along_axis(positions, first[None], axis=0)[0], None
    known = np.isfinite(positions[rest])
    count = known.sum(0)
    total = np.where(known, positions[rest], 0.0).sum(0)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    off = np.where(known, positions[rest] - mean, 0.0)
    noise = np.sqrt(np.where(count > 1, (off**2).sum(0) / np.maximum(count - 1, 1), np.nan))
    return mean, noise if count.max(initial=0) > 1 else None
