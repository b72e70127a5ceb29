"""The surface of a body that is known as particles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from masiv.errors import InputError
from masiv.export.kinematics import particle_spacing
from masiv.export.libraries import require_library
from masiv.report.follow import CarriedPoints

RADIUS = 0.5
"""Of a particle, over the particle spacing."""
SMOOTHING_LENGTH, CELL = 2.0, 1.5
"""Smoothing length and edge of the cells of marching cubes, over the radius."""
ISO_VALUE = 0.6
"""Of the color field, at the surface: a flat face of a lattice is then half a spacing outside of its last layer."""
SMOOTHING_STEPS = 5
"""Of Laplacian smoothing. Chosen: steps of the lattice become slopes; corners are rounded over about a spacing."""


@dataclass(frozen=True)
class Surface:
    """Triangles of a closed surface: vertices (V, 3) float32 [m], triangles (F, 3) int32, counterclockwise seen from
    outside, unit normals (V, 3) float32."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray


def reconstruct_surface(points: np.ndarray, spacing: float | None = None) -> Surface:
    """The surface around particles ``points`` (Q, 3) [m]; spacing [m]: see ``particle_spacing`` (None: measured).

    Marching cubes of the color field of smoothed particle hydrodynamics, smoothed by weights that keep thin parts
    (Löschner et al. 2023, library splashsurf). Raises InputError if pysplashsurf is missing or there is no surface.
    """
    require_library("pysplashsurf", "surfaces")
    import pysplashsurf

    points = np.ascontiguousarray(points, np.float32)
    radius = RADIUS * (particle_spacing(points) if spacing is None else spacing)
    made, _ = pysplashsurf.reconstruction_pipeline(
        points,
        particle_radius=radius,
        smoothing_length=SMOOTHING_LENGTH,
        cube_size=CELL,
        iso_surface_threshold=ISO_VALUE,
        multi_threading=False,  # the order of vertices would differ from call to call
        mesh_cleanup=True,
        mesh_smoothing_weights=True,
        mesh_smoothing_iters=SMOOTHING_STEPS,
    )
    vertices, triangles = np.array(made.mesh.vertices), np.array(made.mesh.triangles).astype(np.int32)
    if len(triangles) == 0:
        raise InputError(f"{len(points)} particles have no surface: they are too few or too far apart")
    return Surface(vertices.astype(np.float32), triangles, vertex_normals(vertices, triangles))


def surfaces(positions: np.ndarray, spacing: float | None = None) -> Iterator[Surface]:
    """``reconstruct_surface`` of each frame of ``positions`` (T, Q, 3) [m]; the spacing is that of frame 0."""
    spacing = particle_spacing(positions[0]) if spacing is None else spacing
    for points in positions:
        yield reconstruct_surface(points, spacing)


def carried_surface(positions: np.ndarray, spacing: float | None = None) -> Iterator[Surface]:
    """The surface at frame 0, its vertices carried by the particles around them: as many surfaces as frames.

    positions (T, Q, 3) [m]. It fits a body that stays in one piece; where matter separates or meets, the surface of
    frame 0 is stretched or cuts through itself.
    """
    first = reconstruct_surface(positions[0], spacing)
    carried = CarriedPoints.at_rest(first.vertices, positions[0])
    for points in positions:
        vertices = carried.moved(points)[0]
        yield Surface(vertices.astype(np.float32), first.triangles, vertex_normals(vertices, first.triangles))


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) float32 of vertices (V, 3): sums of those of the triangles (F, 3), weighted by area."""
    corners = np.asarray(vertices, np.float64)[triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], areas)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # A vertex of triangles without area has no normal of its own; any unit vector is valid.
    return np.where(length > 0, normals / np.maximum(length, np.finfo(float).tiny), [0.0, 1.0, 0.0]).astype(np.float32)


def to_y_up(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that takes ``up`` (3,) to +y."""
    from masiv.scene.transforms import SimulationFrame

    return SimulationFrame.from_scene(up, None).rotation
