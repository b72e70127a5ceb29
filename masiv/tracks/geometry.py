"""Shape of a body at rest, in its own axes. Light: no torch, no taichi."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from masiv.bounds import SIZE
from masiv.errors import InputError, MasivError
from masiv.mesh import read_mesh
from masiv.tracks.declaration import METRES, GeometryDeclaration


@dataclass(frozen=True)
class Geometry:
    """A solid in its own axes. kind: mesh, box, sphere or cylinder; vertices (V, 3) [m] and faces (F, 3) of its surface
    (a primitive's is approximate); volume [m³], exact; lower, upper: corners (3,) [m] of its bounding box."""

    kind: str
    vertices: np.ndarray
    faces: np.ndarray
    volume: float
    lower: np.ndarray
    upper: np.ndarray

    @property
    def size(self) -> float:
        """Longest side of the bounding box [m]."""
        return float((self.upper - self.lower).max())

    @property
    def centroid(self) -> np.ndarray:
        """Centre (3,) [m] of the volume, by the tetrahedra between the origin and the faces."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
        return ((a + b + c) * volumes[:, None]).sum(0) / (4 * volumes.sum())

    def lattice_inside(self, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells of a lattice that divides the bounding box in ``counts`` (3,) parts.

        Centres (counts[0], counts[1], counts[2], 3) [m], and which of them are inside, bool.
        """
        cell = (self.upper - self.lower) / counts
        index = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in counts], indexing="ij"), axis=-1)
        centres = self.lower + cell * index
        if self.kind == "box":
            return centres, np.ones(centres.shape[:3], bool)
        if self.kind == "sphere":
            return centres, (centres**2).sum(-1) <= (0.5 * self.size) ** 2
        if self.kind == "cylinder":
            return centres, (centres[..., :2] ** 2).sum(-1) <= self.upper[0] ** 2
        return centres, self._inside_mesh(counts)

    def _inside_mesh(self, counts: np.ndarray) -> np.ndarray:
        import trimesh

        from masiv.mesh import lattice_inside

        # Crossings keep their parity when each axis is scaled by itself, so cells become unit cubes.
        scaled = (self.vertices - self.lower) * (counts / (self.upper - self.lower))
        cube = lattice_inside(trimesh.Trimesh(scaled, self.faces, process=False), np.arange(counts.max()) + 0.5)
        return cube[: counts[0], : counts[1], : counts[2]]


def make_geometry(declared: GeometryDeclaration, folder: Path) -> Geometry:
    """The solid that ``declared`` says; mesh files are relative to ``folder``. InputError for an unusable mesh."""
    made = _solid(declared, folder)
    SIZE.check(made.size, "scene.yaml: the geometry of a body")
    if not 0 < made.volume < math.inf:
        raise InputError(f"scene.yaml: the geometry of a body has a volume of {made.volume:g} m³: correct its numbers")
    return made


def _solid(declared: GeometryDeclaration, folder: Path) -> Geometry:
    import trimesh

    unit = METRES[declared.units]
    if declared.box is not None:
        sides = unit * np.array(declared.box)
        return _primitive("box", trimesh.creation.box(sides), float(sides.prod()), sides / 2)
    if declared.sphere is not None:
        radius = unit * declared.sphere / 2
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        return _primitive("sphere", mesh, 4 / 3 * math.pi * radius**3, np.full(3, radius))
    if declared.cylinder is not None:
        radius, length = unit * declared.cylinder.diameter / 2, unit * declared.cylinder.length
        mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=48)
        return _primitive("cylinder", mesh, math.pi * radius**2 * length, np.array([radius, radius, length / 2]))
    assert declared.mesh is not None
    mesh = read_mesh(folder / declared.mesh)
    vertices = unit * np.array(mesh.vertices, np.float64)
    volume = abs(float(mesh.volume)) * unit**3
    return Geometry("mesh", vertices, np.array(mesh.faces), volume, vertices.min(0), vertices.max(0))


def _primitive(kind: str, mesh, volume: float, half: np.ndarray) -> Geometry:
    return Geometry(kind, np.array(mesh.vertices, np.float64), np.array(mesh.faces), volume, -half, half)


def fill_geometry(geometry: Geometry, spacing: float) -> np.ndarray:
    """Particles (N, 3) [m, own axes] about ``spacing`` [m] apart: the middles of cells that divide the bounding box
    evenly, where they are inside. Each stands for volume / N. Raises MasivError where fewer than 8 are."""
    counts = np.maximum(np.rint((geometry.upper - geometry.lower) / spacing).astype(int), 1)
    centres, inside = geometry.lattice_inside(counts)
    if inside.sum() < 8:
        raise MasivError(f"the body is thinner than the particle spacing {1e3 * spacing:.2g} mm: choose a smaller one")
    return centres[inside]


def mean_diameter(geometry: Geometry) -> float:
    """Of the sphere [m] with the frontal area that a convex body shows on the average, a quarter of its surface (Cauchy
    1841); a sphere's own."""
    if geometry.kind == "sphere":
        return geometry.size
    a, b, c = (geometry.vertices[geometry.faces[:, k]] for k in range(3))
    surface = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return math.sqrt(surface / math.pi)
