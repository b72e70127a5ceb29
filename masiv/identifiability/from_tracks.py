"""``ObservedMotion`` of a body with markers."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from masiv.identifiability.motion import ObservedMotion, noise_std
from masiv.observations.tracks import MIN_NOISE
from masiv.subsample import evenly_spread
from masiv.tracks.tracks import Run, Tracks

MOST_MARKERS = 12
"""Of which distances are taken in pairs, evenly chosen."""
FEWEST_FRAMES = 3


def observed_markers(tracks: Tracks, run: Run) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Markers of ``run`` that move with its body (indices), and the frames after the release that show them all:
    places (T, M, 3) [m], 0 along axes that were not measured, and times (T,) [s since the release, or the start]."""
    moving, body = run.moving(), tracks.bodies[run.body]
    chosen = body.free_markers(run) or tuple(np.flatnonzero(run.axes.any(axis=1)).tolist())
    chosen = tuple(evenly_spread(chosen, MOST_MARKERS))
    whole = moving.seen[:, list(chosen)].all(axis=1)
    return chosen, np.nan_to_num(moving.positions[whole][:, list(chosen)]), moving.elapsed[whole]


def track_motion(tracks: Tracks, run: Run) -> ObservedMotion | None:
    """The motion of the body of ``run``; None if its markers are all seen in fewer than three frames."""
    body = tracks.bodies[run.body]
    chosen, places, times = observed_markers(tracks, run)
    if len(times) < FEWEST_FRAMES:
        return None
    measured = noise_std(places[:, run.axes[list(chosen)]], MIN_NOISE)
    if run.noise_std is not None:
        measured = max(MIN_NOISE, float(np.sqrt(np.nanmean(run.noise_std[list(chosen)] ** 2))))
    clamped = bool(body.clamps)
    if clamped:
        shape = np.linalg.norm(places - np.nan_to_num(run.at_rest[list(chosen)]), axis=2)
    else:
        pairs = list(combinations(range(len(chosen)), 2))
        shape = (
            np.stack([np.linalg.norm(places[:, a] - places[:, b], axis=1) for a, b in pairs], axis=1)
            if pairs
            else (np.zeros((len(places), 0)))
        )
    geometry, ground = body.geometry, tracks.ground
    size = geometry.size if geometry is not None else float(np.ptp(places[0], axis=0).max())
    lowest = None
    if ground is not None:
        # A lone marker is the middle of the body.
        below = 0.5 * size if len(chosen) == 1 else 0.0
        lowest = (places @ ground.normal).min(axis=1) - ground.height - below
    return ObservedMotion(
        name=run.name, times=times - times[0], centre=places.mean(axis=1), centre_std=measured / np.sqrt(len(chosen)),
        shape=shape, shape_std=measured * (1.0 if clamped else 2**0.5), lowest=lowest, height_std=measured, size=size,
        mass=body.mass, gravity=tracks.gravity, normal=tracks.up if ground is None else ground.normal, clamped=clamped,
        medium_density=tracks.medium_density,
    )  # fmt: skip
