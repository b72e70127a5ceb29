"""Particles and surface as one USD stage with time samples."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.errors import InputError
from masiv.export.gltf import Y_UP
from masiv.export.kinematics import particle_spacing, velocities
from masiv.export.libraries import require_library
from masiv.export.surface import Surface, surfaces, to_y_up
from masiv.files import atomic
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    from masiv.simulation.rollout import Rollout

EXTENSIONS = (".usd", ".usda", ".usdc")


def write_usd(
    rollout: Rollout,
    path: str | Path,
    *,
    up: np.ndarray | tuple[float, float, float] = Y_UP,
    spacing: float | None = None,
    progress: Progress = silent,
) -> None:
    """Write ``path`` (.usd, .usdc or, as text, .usda): ``/body/particles`` and ``/body/surface`` at each frame.

    Particles have ids, widths (the spacing) and velocities [m/s]. The surface is reconstructed at each frame, so its
    triangles change with time, as USD allows. Time codes are frames; ``timeCodesPerSecond`` is the frame rate. Metres.
    A world whose ``up`` (3,) is y or z keeps its axes; another one is turned to y up. spacing [m]: see
    ``reconstruct_surface``. Raises InputError for another extension, if a library is missing or there is no surface.
    """
    path = Path(path)
    if path.suffix.lower() not in EXTENSIONS:
        raise InputError(f"{path} does not end in .usd, .usda or .usdc: give such a name")
    require_library("pxr", "USD files")
    from pxr import Gf, Usd, UsdGeom, Vt

    axis, turn = _axes(np.asarray(up, np.float64))
    positions = (np.asarray(rollout.positions, np.float64) @ turn.T).astype(np.float32)
    times = np.asarray(rollout.times, np.float64)
    speed = velocities(positions, times)
    spacing = particle_spacing(positions[0]) if spacing is None else spacing
    fps = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 24.0
    with atomic(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(times) - 1)
        body = UsdGeom.Xform.Define(stage, "/body")
        stage.SetDefaultPrim(body.GetPrim())
        particles: Any = UsdGeom.Points.Define(stage, "/body/particles")
        particles.CreateIdsAttr(Vt.Int64Array.FromNumpy(np.arange(positions.shape[1])))
        particles.CreateWidthsAttr(Vt.FloatArray([spacing]))
        particles.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        mesh: Any = UsdGeom.Mesh.Define(stage, "/body/surface")
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        mesh.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(0.8, 0.45, 0.15)]))
        for frame, surface in enumerate(surfaces(positions, spacing)):
            _set(particles.GetPointsAttr(), positions[frame], frame)
            _set(particles.GetVelocitiesAttr(), speed[frame], frame)
            _set(particles.GetExtentAttr(), _extent(positions[frame], spacing / 2), frame)
            _set_surface(mesh, surface, frame)
            progress("export", frame + 1, len(positions))
        stage.GetRootLayer().Save()


def _axes(up: np.ndarray) -> tuple[str, np.ndarray]:
    """The up axis of the stage, and the rotation (3, 3) from the world to it."""
    unit = up / np.linalg.norm(up)
    for axis, direction in (("Y", [0, 1, 0]), ("Z", [0, 0, 1])):
        if np.allclose(unit, direction, atol=1e-6):
            return axis, np.eye(3)
    return "Y", to_y_up(up)


def _set_surface(mesh: Any, surface: Surface, frame: int) -> None:
    from pxr import Vt

    _set(mesh.GetPointsAttr(), surface.vertices, frame)
    _set(mesh.GetNormalsAttr(), surface.normals, frame)
    _set(mesh.GetExtentAttr(), _extent(surface.vertices, 0.0), frame)
    count = len(surface.triangles)
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(count, 3, np.int32)), frame)
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(surface.triangles.ravel().astype(np.int32)), frame)


def _set(attribute: Any, vectors: np.ndarray, frame: int) -> None:
    from pxr import Vt

    attribute.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vectors, np.float32)), frame)


def _extent(points: np.ndarray, margin: float) -> np.ndarray:
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
