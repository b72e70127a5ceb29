"""Solids as surface meshes and as the particles that fill them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import Rotation

from masiv.mesh import lattice_inside, read_mesh

_FACETS_ALONG = 30
"""Edges are at most 1 / 30 of the size, so that the surface can bend."""


class ShapeSpec(BaseModel):
    """A solid over the ground (y = 0). The longest side of its bounding box is ``size`` before it is turned."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["cube", "sphere", "capsule", "cylinder", "torus", "cross", "mesh"] = "cube"
    mesh: Path | None = Field(
        default=None, description="a watertight triangle mesh, for kind mesh; relative to the spec"
    )
    size: float = Field(default=0.5, gt=0, description="longest side [m]")
    rotation_deg: tuple[float, float, float] = Field(
        default=(0, 0, 0), description="about the fixed axes x, then y, then z"
    )
    position: tuple[float, float] = Field(default=(0, 0), description="x, z of the box's centre [m]")
    clearance: float = Field(default=0.15, ge=0, description="lowest point above the ground [m]")

    @model_validator(mode="after")
    def _mesh_is_given(self) -> ShapeSpec:
        if (self.kind == "mesh") != (self.mesh is not None):
            raise ValueError("kind mesh and the key mesh go together")
        return self


@dataclass(frozen=True)
class Solid:
    """A body at rest: vertices (V, 3) [m, world], faces (F, 3) counter-clockwise from outside, particles (N, 3) [m],
    volume [m^3], local (V, 3) the vertices in the shape's own axes, in units of its size: where its texture is."""

    vertices: np.ndarray
    faces: np.ndarray
    particles: np.ndarray
    volume: float
    local: np.ndarray


def make_body(spec: ShapeSpec, particle_count: int) -> Solid:
    """The body of ``spec`` filled with about ``particle_count`` particles. Raises InputError for an unusable mesh."""
    solids = _solids(spec)
    corners = np.concatenate([solid.vertices for solid in solids])
    middle, side = (corners.max(0) + corners.min(0)) / 2, np.ptp(corners, axis=0).max()
    for solid in solids:
        solid.apply_translation(-middle)
        solid.apply_scale(1 / side)
    lattice, spacing = _fill(solids, particle_count)
    fine = [_subdivided(solid) for solid in solids]
    local = np.concatenate([vertices for vertices, _ in fine])
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in fine[:-1])])
    faces = np.concatenate([f + offset for (_, f), offset in zip(fine, offsets, strict=True)])
    turn = spec.size * Rotation.from_euler("xyz", spec.rotation_deg, degrees=True).as_matrix().T
    vertices, particles = local @ turn, lattice @ turn
    low, high = vertices.min(0), vertices.max(0)
    shift = np.array([spec.position[0], spec.clearance, spec.position[1]])
    shift -= [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]
    return Solid(vertices + shift, faces, particles + shift, len(lattice) * (spacing * spec.size) ** 3, local)


def _subdivided(solid: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    divided = trimesh.remesh.subdivide_to_size(solid.vertices, solid.faces, 1 / _FACETS_ALONG, max_iter=20)
    return divided[0], divided[1]


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
    assert spec.mesh is not None
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
            inside |= lattice_inside(solid, axis)
        spacing *= (max(inside.sum(), 1) / count) ** (1 / 3)
        found, used = np.argwhere(inside), axis
    return used[found] @ askew, used[1] - used[0]
