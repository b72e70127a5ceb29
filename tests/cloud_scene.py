"""Point clouds of an ellipsoid that moves and spins, sampled afresh in every frame, and where its material truly is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

AXES = np.array([0.30, 0.20, 0.12])
VOLUME = 4 / 3 * np.pi * float(AXES.prod())
FPS, START, VELOCITY, SPIN = 24.0, np.array([0.1, 0.6, -0.2]), np.array([0.9, -0.6, 0.3]), np.array([0.6, 0.4, 1.2])


def rotation(frame: int) -> Rotation:
    return Rotation.from_rotvec(SPIN * frame / FPS)


def moved(points: np.ndarray, frame: int) -> np.ndarray:
    """Where material points (N, 3) [m] of frame 0 are at ``frame``."""
    return rotation(frame).apply(points - START) + START + VELOCITY * frame / FPS


def surface(count: int, frame: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals (N, 3) of another sampling in each frame; ``noise`` [m]: standard deviation."""
    random = np.random.default_rng((5, frame))
    unit = random.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit / AXES
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = moved(START + unit * AXES, frame) + noise * random.normal(size=(count, 3))
    return points, rotation(frame).apply(normals)


def write_cloud(path: Path, points: np.ndarray, normals: np.ndarray | None = None, grey: int | None = None) -> None:
    columns = dict(zip("xyz", points.T, strict=True))
    if normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    kinds = [(name, "f8") for name in columns]
    if grey is not None:
        columns |= {name: np.full(len(points), grey) for name in ("red", "green", "blue")}
        kinds += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), dtype=kinds)
    for name, column in columns.items():
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def write_scene(folder: Path, frames: int, *, count: int = 2500, noise: float = 0.0, normals: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        points, outwards = surface(count, frame, noise)
        write_cloud(folder / f"cloud_{frame}.ply", points, outwards if normals else None)
    (folder / "scene.yaml").write_text("fps: 24\nup_axis: y\nground: none\ngravity: 0\n")
    return folder
