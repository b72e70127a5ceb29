"""Particles as one VTK-HDF file with all time steps, which ParaView opens.

Layout: "VTKHDF File Format", section "PolyData" and "Temporal Data" of the VTK documentation. Every step has all points
and point data of its own; the cells, one vertex a point, are shared by all steps.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.export.kinematics import Deformation, equivalent_strain, velocities, volume_ratio
from masiv.export.libraries import require_library
from masiv.files import atomic
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    import h5py

    from masiv.simulation.rollout import Rollout

VERSION = (2, 0)
NO_CELLS = ("Lines", "Strips", "Polygons")


def write_vtkhdf(rollout: Rollout, path: str | Path, *, progress: Progress = silent) -> None:
    """Write the particles of ``rollout`` to ``path`` (.vtkhdf), one time step a frame at its time [s].

    Point data: ``velocity`` [m/s], ``displacement`` since frame 0 [m], ``particle`` (number) and, of a body that fills
    a volume, the total ``deformation_gradient`` since frame 0 by least squares over neighbours (row by row), its
    determinant ``volume_ratio`` and the ``equivalent_strain`` (sqrt(2/3) |dev ln V|). There is no stress: it depends on
    the elastic part of the deformation, which positions do not tell. Raises InputError if h5py is missing.
    """
    require_library("h5py", "VTK-HDF files")
    import h5py

    positions = np.asarray(rollout.positions, np.float32)
    steps, count, _ = positions.shape
    speed = velocities(positions, rollout.times)
    deformation = Deformation.since(positions[0])
    with atomic(Path(path)) as temporary, h5py.File(temporary, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(VERSION, np.int64)
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len("PolyData")))
        _cells(root, steps, count)
        _time(root, rollout.times, count)
        points = _array(root, "Points", steps * count, 3)
        arrays: dict[str, h5py.Dataset] = {}
        for step, now in enumerate(positions):
            rows = slice(step * count, (step + 1) * count)
            data: dict[str, np.ndarray] = {
                "velocity": speed[step],
                "displacement": now - positions[0],
                "particle": np.arange(count, dtype=np.int32),
            }
            if deformation is not None:
                gradients = deformation.gradients(now)
                data["deformation_gradient"] = gradients.reshape(count, 9)
                data["volume_ratio"] = volume_ratio(gradients)
                data["equivalent_strain"] = equivalent_strain(gradients)
            points[rows] = now
            for name, values in data.items():
                if step == 0:
                    arrays[name] = _point_data(root, name, values, steps)
                arrays[name][rows] = values
            progress("export", step + 1, steps)


def _cells(root: h5py.Group, steps: int, count: int) -> None:
    root["NumberOfPoints"] = np.full(steps, count)
    vertices = root.create_group("Vertices")
    vertices["NumberOfCells"] = np.full(steps, count)
    vertices["NumberOfConnectivityIds"] = np.full(steps, count)
    vertices["Offsets"] = np.arange(count + 1)
    vertices["Connectivity"] = np.arange(count)
    for name in NO_CELLS:
        group = root.create_group(name)
        group["NumberOfCells"] = np.zeros(steps, np.int64)
        group["NumberOfConnectivityIds"] = np.zeros(steps, np.int64)
        group["Offsets"] = np.zeros(1, np.int64)
        group["Connectivity"] = np.zeros(0, np.int64)


def _time(root: h5py.Group, times: np.ndarray, count: int) -> None:
    steps = len(times)
    group = root.create_group("Steps")
    group.attrs["NSteps"] = steps
    group["Values"] = np.asarray(times, np.float64)
    group["PartOffsets"] = np.arange(steps)
    group["NumberOfParts"] = np.ones(steps, np.int64)
    group["PointOffsets"] = np.arange(steps) * count
    # Columns: vertices, lines, polygons, strips.
    group["CellOffsets"] = np.zeros((steps, 4), np.int64)
    group["ConnectivityIdOffsets"] = np.zeros((steps, 4), np.int64)


def _point_data(root: h5py.Group, name: str, values: np.ndarray, steps: int) -> h5py.Dataset:
    count, columns = len(values), values.shape[1] if values.ndim > 1 else 0
    kind: Any = values.dtype if values.dtype.kind == "i" else np.float32
    root[f"Steps/PointDataOffsets/{name}"] = np.arange(steps) * count
    return _array(root, f"PointData/{name}", steps * count, columns, kind)


def _array(root: h5py.Group, name: str, rows: int, columns: int, kind: Any = np.float32) -> h5py.Dataset:
    shape = (rows, columns) if columns else (rows,)
    return root.create_dataset(name, shape, kind, compression="gzip", compression_opts=4)
