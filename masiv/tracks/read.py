"""The layout of tracks: a ``scene.yaml`` with ``layout: tracks``, and CSV, C3D, TRC or TSV files of marker positions.

Positions are in m, cm or mm, converted to metres; times in seconds; gaps are NaN. Light: no torch, no taichi.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.bounds import FPS, LENGTH, TIME
from masiv.errors import InputError
from masiv.scene.layout import Layout
from masiv.strict import read_yaml, validated
from masiv.tracks.declaration import METRES, BodyDeclaration, ClampDeclaration, RunDeclaration, TracksDeclaration
from masiv.tracks.geometry import Geometry, fill_geometry, make_geometry
from masiv.tracks.placement import Placement, best_rigid
from masiv.tracks.point_table import Table
from masiv.tracks.release import estimate_release
from masiv.tracks.table import read_table
from masiv.tracks.tracks import Clamp, Run, TrackedBody, Tracks, rest_positions


def can_read(folder: Path) -> bool:
    """Whether ``folder`` is a scene of tracks."""
    path = folder / "scene.yaml"
    return path.is_file() and read_yaml(path).get("layout") == "tracks"


def read_tracks(folder: Path) -> Tracks:
    """The tracks in ``folder``. Raises InputError for an unknown key, a bad value or a file that cannot be used.

    Lesser defects are in ``problems``.
    """
    where = folder / "scene.yaml"
    declared = validated(TracksDeclaration, read_yaml(where), str(where))
    environment = declared.environment()
    up = environment.up("z")
    bodies = {name: _body(name, body, folder) for name, body in declared.bodies.items()}
    problems: list[str] = []
    runs = tuple(_run(run, declared, bodies, folder, problems) for run in declared.runs)
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{where}: two runs are named '{name}': give each its name")
    if not any(run.purpose == "fit" for run in runs):
        raise InputError(f"{where}: no run is there to fit on: give one `use: fit`")
    for name in bodies:
        if not any(run.body == name for run in runs):
            problems.append(f"body {name} has no run")
    return Tracks(
        path=folder,
        up=up,
        gravity=environment.gravity_vector(up, 9.8),
        ground=environment.ground_plane(up, None),
        bodies=bodies,
        runs=runs,
        problems=tuple(problems),
        medium_density=declared.medium_density,
        medium_viscosity=declared.medium_viscosity,
    )


def _body(name: str, declared: BodyDeclaration, folder: Path) -> TrackedBody:
    geometry, clamps = None, ()
    density, mass = declared.density, declared.mass
    if declared.geometry is not None:
        geometry = make_geometry(declared.geometry, folder)
        density = mass / geometry.volume if mass is not None else density
        mass = density * geometry.volume if density is not None else None
        clamps = _clamps(name, declared, geometry)
    group = name if declared.group is None else declared.group
    return TrackedBody(name, group, geometry, density, mass, declared.poissons_ratio, clamps)


def _clamps(name: str, body: BodyDeclaration, geometry: Geometry) -> tuple[Clamp, ...]:
    assert body.geometry is not None
    unit = METRES[body.geometry.units]
    clamps = tuple(_clamp(name, declared, unit, geometry) for declared in body.clamp)
    if (
        clamps
        and _all_held(clamps, geometry.vertices)
        and _all_held(clamps, fill_geometry(geometry, geometry.size / 20))
    ):
        raise InputError(f"scene.yaml: bodies.{name}.clamp holds the whole body: nothing is free to move")
    several = [marker for clamp in clamps for marker in clamp.markers]
    for marker in set(several):
        if several.count(marker) > 1:
            raise InputError(f"scene.yaml: bodies.{name}.clamp: marker {marker} is fixed to two clamps: choose one")
    return clamps


def _all_held(clamps: tuple[Clamp, ...], points: np.ndarray) -> bool:
    return bool(np.any([clamp.holds(points) for clamp in clamps], axis=0).all())


def _clamp(name: str, declared: ClampDeclaration, unit: float, geometry: Geometry) -> Clamp:
    if declared.half_space is not None:
        normal = np.array(declared.half_space.normal)
        length = np.linalg.norm(normal)
        if length < 1e-9:
            raise InputError(f"scene.yaml: bodies.{name}.clamp.half_space.normal is zero, it must be a direction")
        normals, heights = normal[None] / length, np.array([unit * declared.half_space.height])
    else:
        assert declared.box is not None
        low, high = unit * np.minimum(*declared.box), unit * np.maximum(*declared.box)
        if (high - low).min() <= 0:
            raise InputError(f"scene.yaml: bodies.{name}.clamp.box is flat: give two opposite corners")
        normals, heights = np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -low])
    clamp = Clamp(normals, heights, declared.markers, declared.prescribed_motion)
    touched, slack = geometry.vertices, 1e-6 * geometry.size
    if not Clamp(normals, heights + slack, ()).holds(touched).any():
        raise InputError(
            f"scene.yaml: bodies.{name}.clamp holds no part of the geometry, which spans {_extent(geometry)} m in "
            "its own axes: correct its numbers"
        )
    return clamp


def _extent(geometry: Geometry) -> str:
    return " × ".join(f"{low:.4g}…{high:.4g}" for low, high in zip(geometry.lower, geometry.upper, strict=True))


def _run(
    run: RunDeclaration, declared: TracksDeclaration, bodies: dict[str, TrackedBody], folder: Path, problems: list[str]
) -> Run:
    values = [str(value) for value in run.select.values()]
    name = run.name or " ".join(values) or run.file.stem
    where = f"run {name}"
    body = run.body if run.body is not None else next(iter(bodies))
    if body not in bodies or (run.body is None and len(bodies) > 1):
        raise InputError(f"scene.yaml: {where}: say which body it is of: one of {', '.join(bodies)}")
    table = read_table(folder / run.file, declared.columns, run.select)
    markers, positions = _select_markers(where, run, table)
    positions = positions * _unit(where, table, declared, problems)
    times, rate = _times(where, table, declared, problems)
    LENGTH.check(float(np.nanmax(np.abs(positions), initial=0)), f"{folder / run.file}: a position")
    if table.ignored:
        problems.append(f"{where}: columns not used: {', '.join(table.ignored)}")
    for m, marker in enumerate(markers):
        if not np.isfinite(positions[:, m]).any():
            raise InputError(f"scene.yaml: {where}: marker {marker} was never seen: leave it out with markers")
    rest = None
    if run.rest_frames is not None:
        if run.rest_frames[1] > len(times):
            raise InputError(
                f"scene.yaml: {where}: rest_frames end at {run.rest_frames[1]}, the run has {len(times)} frames"
            )
        rest = slice(*run.rest_frames)
    held = bodies[body].held_markers
    for marker in held:
        if marker not in markers:
            problems.append(f"{where}: marker {marker} of the clamp is not in it")
    if run.release_time is not None and not times[0] <= run.release_time < times[-1]:
        raise InputError(
            f"scene.yaml: {where}: release_time {run.release_time:g} is outside of {times[0]:g} to {times[-1]:g} s"
        )
    at_rest, noise = rest_positions(positions, rest)
    for m, marker in enumerate(markers):
        if np.isnan(at_rest[m][np.isfinite(positions[:, m]).any(axis=0)]).any():
            problems.append(f"{where}: marker {marker} is not seen at rest, so it is not tied to the body")
    release = run.release_time
    carried = any(clamp.prescribed for clamp in bodies[body].clamps)
    if carried and run.ignore_after_release:
        raise InputError(f"scene.yaml: {where}: ignore_after_release is for a clamp that does not move: leave it out")
    if carried and release is None:  # the clamp moves first, and then the body
        if rest is None:
            raise InputError(f"scene.yaml: {where}: its clamp moves: give rest_frames, or release_time before it does")
        release = float(times[rest.stop - 1])
    if rest is not None and noise is not None and release is None:
        free = [m for m, marker in enumerate(markers) if marker not in held]
        release = estimate_release(times, positions[:, free], rest, at_rest[free], noise[free])
        if release is None:
            problems.append(f"{where}: it never leaves its rest position by more than the noise: no release found")
    made = Run(name, body, run.condition, run.use, markers, times, positions, rate, rest, at_rest, noise, release, None,
               run.ignore_after_release, run.held_straight)  # fmt: skip
    made = replace(made, placement=_placement(where, made, declared.bodies[body], problems))
    return made if run.time is None else made.between(*run.time)


def _select_markers(where: str, run: RunDeclaration, table: Table) -> tuple[tuple[str, ...], np.ndarray]:
    if run.markers is None:
        return table.markers, table.positions
    named = run.markers if isinstance(run.markers, dict) else {marker: marker for marker in run.markers}
    for marker in named.values():
        if marker not in table.markers:
            raise InputError(
                f"scene.yaml: {where}: no marker '{marker}' in {run.file}: it has {', '.join(table.markers)}"
            )
    return tuple(named), table.positions[:, [table.markers.index(marker) for marker in named.values()]]


def _unit(where: str, table: Table, declared: TracksDeclaration, problems: list[str]) -> float:
    """Metres per unit of the file. A unit in scene.yaml takes precedence."""
    if declared.units is None and table.unit is None:
        raise InputError(f"scene.yaml: {where}: its file does not say its unit: give `units: m`, cm or mm")
    if declared.units is not None and table.unit not in (None, declared.units):
        problems.append(f"{where}: the file says {table.unit}, scene.yaml {declared.units}: the latter is used")
    return METRES[declared.units or table.unit or "m"]


def _times(where: str, table: Table, declared: TracksDeclaration, problems: list[str]) -> tuple[np.ndarray, float]:
    """Times (T,) [s] and the rate [Hz]."""
    count = len(table.positions)
    if count < 3:
        raise InputError(f"scene.yaml: {where} has {count} frames: a motion needs three or more")
    if table.times is None:
        if declared.rate is None:
            raise InputError(
                f"scene.yaml: {where}: its file has no time: name the column in columns.time, or give rate [Hz]"
            )
        return np.arange(count) / declared.rate, declared.rate
    times = table.times
    TIME.check(float(np.nanmax(np.abs(times), initial=0)), f"scene.yaml: {where}: a time of its file")
    if not np.isfinite(times).all():
        raise InputError(f"scene.yaml: {where}: frame {int(np.argmin(np.isfinite(times)))} has no time")
    steps = np.diff(times)
    if steps.min() <= 0:
        frame = int(np.argmax(steps <= 0)) + 1
        raise InputError(
            f"scene.yaml: {where}: time goes from {times[frame - 1]:g} to {times[frame]:g} s at frame {frame}, it must "
            "increase (a file of several recordings needs select)"
        )
    usual = float(np.median(steps))
    FPS.check(1 / usual, f"scene.yaml: {where}: the rate of its times")
    uneven = float(np.abs(steps / usual - 1).max())
    if uneven > 0.05:
        problems.append(f"{where}: frames are not even: {1e3 * steps.min():.1f} to {1e3 * steps.max():.1f} ms apart")
    if declared.rate is not None and abs(declared.rate * usual - 1) > 0.01:
        problems.append(f"{where}: rate {declared.rate:g} Hz, but its times say {1 / usual:.4g}: times are used")
    return times, 1 / usual


def _placement(where: str, run: Run, body: BodyDeclaration, problems: list[str]) -> Placement | None:
    declared = body.geometry
    if declared is None:
        return None
    turn = np.eye(3)
    if declared.rotation_deg is not None:
        turn = Rotation.from_euler("xyz", declared.rotation_deg, degrees=True).as_matrix()
    if declared.markers_at is None:
        return Placement(turn, np.zeros(3) if declared.position is None else np.array(declared.position))
    markers = list(declared.markers_at)
    own = METRES[declared.units] * np.array([declared.markers_at[marker] for marker in markers])
    world = run.at_rest[[run.marker(marker) for marker in markers]]
    if len(markers) == 1:
        # An axis that was not measured is 0: its origin is arbitrary.
        return Placement(turn, np.where(run.axes[run.marker(markers[0])], world[0], 0.0) - turn @ own[0])
    if not np.isfinite(world).all():
        raise InputError(
            f"scene.yaml: {where}: geometry.markers_at needs all axes of {', '.join(markers)} at rest: "
            "lengthen rest_frames"
        )
    for name, points in (("markers_at", own), ("the rest positions", world)):
        if np.linalg.svd(points - points.mean(0), compute_uv=False)[1] < 1e-6 * np.ptp(points, axis=0).max():
            raise InputError(
                f"scene.yaml: {where}: {name} of {', '.join(markers)} lie on a line: name one that does not"
            )
    placement = best_rigid(own, world)
    size = float(np.ptp(own, axis=0).max())
    if placement.error > 0.03 * size:
        problems.append(
            f"{where}: markers are {1e3 * placement.error:.1f} mm (RMS) from geometry.markers_at after the best"
            " rigid motion: check their order and units"
        )
    return placement


LAYOUT = Layout("tracks", "scene.yaml with layout: tracks", can_read, read_tracks)
