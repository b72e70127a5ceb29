"""The twin that a scene of tracks describes: bodies, surroundings and how each fitted run starts, without effects."""

from __future__ import annotations

import numpy as np

from masiv.effects.per_body import DragBody
from masiv.errors import InputError
from masiv.mpm.config import SimulatorConfig
from masiv.tracks.config import TracksConfig
from masiv.tracks.geometry import fill_geometry, mean_diameter
from masiv.tracks.placement import Placement
from masiv.tracks.prescribed_motion import prescribed_motions
from masiv.tracks.tracks import Run, TrackedBody, Tracks
from masiv.twin.body import Body, Boundary, InitialCondition, Release
from masiv.twin.twin import Twin


def drag_body(tracks: Tracks, body: TrackedBody) -> DragBody:
    """What the medium sees of a body. Raises InputError if its geometry or mass is not known."""
    if body.geometry is None or body.mass is None:
        raise InputError(f"{tracks.path}: body {body.name} needs a geometry, and a density or a mass")
    return DragBody(mean_diameter(body.geometry), body.mass, tracks.medium_density, tracks.medium_viscosity)


def particle_spacing(volume: float, config: TracksConfig) -> float:
    """[m], of a body of ``volume`` [m^3]."""
    return (volume / config.particles) ** (1 / 3)


def twin_of_tracks(tracks: Tracks, config: TracksConfig, simulator: SimulatorConfig, *, rigid: bool) -> Twin:
    """rigid: each body is a point mass; otherwise it deforms, and its law is still None. Runs of the scene's first
    condition come first. Raises InputError for a body without geometry or mass, and for a run that cannot be used."""
    conditions = list(dict.fromkeys(run.condition for run in tracks.runs))
    fitted = [run for condition in conditions for run in tracks.chosen("fit", condition=condition)]
    bodies = tuple(_body(tracks, tracks.bodies[name], config, rigid) for name in dict.fromkeys(r.body for r in fitted))
    starts = tuple(_flight(run) if rigid else _release(tracks, run, config) for run in fitted)
    contact = "none" if tracks.ground is None or rigid else "sticky"
    return Twin(
        bodies=bodies,
        boundary=Boundary(tracks.ground, contact),
        gravity=np.asarray(tracks.gravity, dtype=np.float64),
        up=np.asarray(tracks.up, dtype=np.float64),
        initial_conditions=starts,
        simulator=simulator,
    )


def _body(tracks: Tracks, body: TrackedBody, config: TracksConfig, rigid: bool) -> Body:
    drag = drag_body(tracks, body)
    assert body.geometry is not None  # drag_body raises otherwise
    assert body.density is not None
    volume = body.geometry.volume
    if rigid:
        return Body(body.name, volume, body.density, geometry=body.geometry.kind, drag=drag)
    spacing = particle_spacing(volume, config)
    particles = fill_geometry(body.geometry, spacing)
    return Body(body.name, volume, body.density, None, particles, spacing, body.clamps, body.geometry.kind, drag)


def _flight(run: Run) -> InitialCondition:
    """Where the marker is in the first frame of its flight; axes that were not measured start at 0."""
    moving = run.moving()
    seen = np.flatnonzero(moving.seen[:, 0])
    if not len(seen):
        raise InputError(f"run {run.name}: its marker is seen in no frame of its flight")
    first = np.nan_to_num(moving.positions[seen[0], 0])
    start = Placement(np.eye(3), first)
    return InitialCondition(run.name, run.body, run.rate, np.zeros(3), np.zeros(3), run.condition, start)


def _release(tracks: Tracks, run: Run, config: TracksConfig) -> InitialCondition:
    free = tracks.bodies[run.body].free_markers(run)
    _, _, speed = run.released(free, run.ignore_after_release, config.duration)
    markers = {run.markers[m]: run.at_rest[m] for m in free}
    release = Release(markers, speed, motions=prescribed_motions(run, tracks.bodies[run.body].clamps))
    return InitialCondition(
        run.name, run.body, run.rate, np.zeros(3), np.zeros(3), run.condition, run.placement, release
    )  # fmt: skip
