"""Bodies with markers that something holds or supports without being declared."""

from __future__ import annotations

import numpy as np

from masiv.identifiability.fall import fall_problem
from masiv.identifiability.from_tracks import FEWEST_FRAMES, observed_markers
from masiv.identifiability.held import Held, MediumForce, held
from masiv.identifiability.motion import NEAR_GROUND, noise_std
from masiv.observations.tracks import MIN_NOISE
from masiv.tracks.geometry import mean_diameter
from masiv.tracks.placement import best_rigid
from masiv.tracks.tracks import Run, TrackedBody, Tracks

MOST_DRAG = 3.0
"""Drag coefficient: the upper bound of ``quadratic_drag``; lift is smaller."""
MOST_STOKES = 10.0
"""Times the Stokes drag of a sphere: the bound of ``linear_drag``."""
LIGHTEST = 0.08
"""Mass per frontal area [kg/m²] of a body whose mass or geometry is not declared: that of a sheet of paper."""
HALF_DIAGONAL = 0.75**0.5
"""Of a cube: no point of a body is further from its middle, in its longest side."""
VERTICAL = 0.01
"""Part of gravity along an axis that was not measured, at most."""


def held_problems(tracks: Tracks, runs: tuple[Run, ...] | None = None) -> list[str]:
    """A sentence for each of ``runs`` (None: all) whose body is held or supported by something undeclared."""
    found = ((run.name, held_in(tracks, run)) for run in (tracks.runs if runs is None else runs))
    return [f"run {name}: {what.sentence()}" for name, what in found if what is not None]


def held_in(tracks: Tracks, run: Run) -> Held | None:
    """What holds the body of ``run`` after its release without being declared. None if nothing does, if the body has a
    clamp or never leaves its declared rest, if the vertical was not measured, or if it falls along another axis than
    gravity."""
    body, gravity = tracks.bodies[run.body], tracks.gravity
    size = float(np.linalg.norm(gravity))
    if body.clamps or size == 0 or (run.rest is not None and run.release is None):
        return None
    chosen, places, times = observed_markers(tracks, run)
    if len(times) < FEWEST_FRAMES:
        return None
    measured = run.axes[list(chosen)].all(axis=0)
    if np.abs(gravity[~measured]).max(initial=0.0) > VERTICAL * size:
        return None
    points = _centre_of_mass(body, run, chosen, places)
    std = noise_std(points[:, :, measured].reshape(len(points), -1), MIN_NOISE)
    if run.noise_std is not None:
        std = max(std, float(np.sqrt(np.nanmean(run.noise_std[list(chosen)] ** 2))))
    if fall_problem(times, points.mean(axis=1), std, gravity) is not None:
        return None
    clear = _clear_of_ground(tracks, body, points, std)
    since = run.times[0] if run.release is None else run.release  # as the file counts
    return held(times + since, points, std, clear, gravity, medium_force(tracks, body))


def medium_force(tracks: Tracks, body: TrackedBody) -> MediumForce:
    """What the medium can do to ``body`` at most."""
    size, density = float(np.linalg.norm(tracks.gravity)), tracks.medium_density
    if body.geometry is None or body.mass is None or body.density is None:
        return MediumForce(0.0, 0.0, 0.5 * density * MOST_DRAG / LIGHTEST)
    diameter, ratio = mean_diameter(body.geometry), density / body.density
    # A body that floats up takes half of its volume of the medium along (a sphere's added mass).
    return MediumForce(
        size * 1.5 * ratio / (1 + 0.5 * ratio),
        MOST_STOKES * 3 * np.pi * tracks.medium_viscosity * diameter / body.mass,
        MOST_DRAG * density * np.pi * diameter**2 / (8 * body.mass),
    )


def _centre_of_mass(body: TrackedBody, run: Run, chosen: tuple[int, ...], places: np.ndarray) -> np.ndarray:
    """Points (T, M, 3) [m] about the centre of mass: that point itself (M = 1) by the rigid motion of three markers or
    more on a body whose geometry is declared, else the markers."""
    if body.geometry is None or run.placement is None or len(chosen) < 3:
        return places
    own = run.placement.to_own(run.at_rest[list(chosen)])
    if not np.isfinite(own).all():
        return places
    sizes = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)
    if sizes[1] < 0.05 * sizes[0]:  # nearly on a line: the turn about it is not known
        return places
    middle = body.geometry.centroid
    return np.stack([best_rigid(own, frame).to_world(middle) for frame in places])[:, None]


def _clear_of_ground(tracks: Tracks, body: TrackedBody, points: np.ndarray, std: float) -> np.ndarray:
    """Frames (T,) in which the body cannot have touched the declared ground, not even between its neighbours."""
    if tracks.ground is None:
        return np.ones(len(points), bool)
    spread = float(np.ptp(points, axis=1).max())
    size = body.geometry.size if body.geometry is not None else spread
    height = (points @ tracks.ground.normal).min(axis=1) - tracks.ground.height
    steps = np.abs(np.diff(height))
    reach = np.maximum(np.concatenate([steps, [0.0]]), np.concatenate([[0.0], steps]))
    return height - reach > (HALF_DIAGONAL + NEAR_GROUND) * size + std
