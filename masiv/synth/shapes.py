"""Bodies as surface meshes and as the particles that fill them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from masiv.mesh import read_mesh
from masiv.synth.spec import ShapeSpec

_FACETS_ALONG = 30
"""Edges are at most this share of the size, so that the surface can bend."""


@dataclass(frozen=True)
class Body:
    """A body at rest: vertices (V, 3) [m, world], faces (F, 3) counter-clockwise from outside, particles (N, 3) [m],
    volume [m^3], local (V, 3) the vertices in the shape's own axes, in units of its size: where its texture is."""

    vertices: np.ndarray
    faces: np.ndarray
    particles: np.ndarray
    volume: float
    local: np.ndarray


def make_body(spec: ShapeSpec, particle_count: int) -> Body:
    """The body of ``spec`` filled with about ``particle_count`` particles. Raises InputError for an unusable mesh."""
    solids = _solids(spec)
    corners = np.concatenate([solid.vertices for solid in solids])
    middle, side = (corners.max(0) + corners.min(0)) / 2, np.ptp(corners, axis=0).max()
    for solid in solids:
        solid.apply_translation(-middle)
        solid.apply_scale(1 / side)
    lattice, spacing = _fill(solids, particle_count)
    fine = [trimesh.remesh.subdivide_to_size(s.vertices, s.faces, 1 / _FACETS_ALONG, max_iter=20) for s in solids]
    local = np.concatenate([vertices for vertices, _ in fine])
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in fine[:-1])])
    faces = np.concatenate([f + offset for (_, f), offset in zip(fine, offsets, strict=True)])
    turn = spec.size * Rotation.from_euler("xyz", spec.rotation_deg, degrees=True).as_matrix().T
    vertices, particles = local @ turn, lattice @ turn
    low, high = vertices.min(0), vertices.max(0)
    shift = np.array([spec.position[0], spec.clearance, spec.position[1]])
    shift -= [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]
    return Body(vertices + shift, faces, particles + shift, len(lattice) * (spacing * spec.size) ** 3, local)


def _solids(spec: ShapeSpec) -> list[trimesh.Trimesh]:
    """Closed meshes whose union is the shape, any size."""
    creation = trimesh.creation
    match spec.kind:
        case "cube":
            return [creation.box((1, 1, 1))]
        case "sphere":
            return [creation.icosphere(subdivisions=4)]
        case "capsule":
            return [creation.capsule(height=1.0, radius=0.45, count=[32, 32])]
        case "cylinder":
            return [creation.cylinder(radius=0.4, height=1.0, sections=48)]
        case "torus":
            return [creation.torus(major_radius=0.34, minor_radius=0.16, major_sections=64, minor_sections=32)]
        case "cross":
            return [creation.box(np.where(np.arange(3) == axis, 1.0, 0.36)) for axis in range(3)]
    mesh = read_mesh(spec.mesh)
    if mesh.volume < 0:
        mesh.invert()
    return [mesh]


def _fill(solids: list[trimesh.Trimesh], count: int) -> tuple[np.ndarray, float]:
    """A cubic lattice of about ``count`` points inside of any of ``solids`` (unit size), and its spacing.

    The lattice is askew to the shape's axes: along them, a flat side would gain or lose a whole layer.
    """
    askew = Rotation.from_euler("xyz", [0.4, 0.7, 0.2]).as_matrix()
    solids = [trimesh.Trimesh(solid.vertices @ askew.T, solid.faces, process=False) for solid in solids]
    spacing = 1 / 40
    for _ in range(3):
        axis = np.arange(-0.87 + spacing / 2, 0.87, spacing)
        inside = np.zeros((len(axis),) * 3, bool)
        for solid in solids:
            inside |= _inside(solid, axis)
        spacing *= (max(inside.sum(), 1) / count) ** (1 / 3)
        found, used = np.argwhere(inside), axis
    return used[found] @ askew, used[1] - used[0]


def _inside(mesh: trimesh.Trimesh, axis: np.ndarray) -> np.ndarray:
    """Which points of the lattice axis x axis x axis are inside, (A, A, A) bool, by the parity of crossings along z."""
    count, step = len(axis), axis[1] - axis[0]
    # Off the lattice by a hair, so that no column runs along an edge.
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - [1.3e-7, 2.9e-7, 0] for k in range(3))
    crossings = np.zeros((count, count, count + 1), np.int32)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    for i in np.flatnonzero(np.abs(area) > 1e-14):
        corner = np.stack([a[i], b[i], c[i]])
        low = np.maximum(np.ceil((corner[:, :2].min(0) - axis[0]) / step).astype(int), 0)
        high = np.minimum(np.floor((corner[:, :2].max(0) - axis[0]) / step).astype(int) + 1, count)
        if (high <= low).any():
            continue
        x, y = np.meshgrid(axis[low[0] : high[0]], axis[low[1] : high[1]], indexing="ij")
        u = ((x - a[i, 0]) * (c[i, 1] - a[i, 1]) - (y - a[i, 1]) * (c[i, 0] - a[i, 0])) / area[i]
        v = ((b[i, 0] - a[i, 0]) * (y - a[i, 1]) - (b[i, 1] - a[i, 1]) * (x - a[i, 0])) / area[i]
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        z = a[i, 2] + u * (b[i, 2] - a[i, 2]) + v * (c[i, 2] - a[i, 2])
        first = np.clip(np.ceil((z - axis[0]) / step).astype(int), 0, count)
        rows, columns = np.nonzero(hit)
        np.add.at(crossings, (rows + low[0], columns + low[1], first[hit]), 1)
    return np.cumsum(crossings, axis=2)[:, :, :count] % 2 == 1
