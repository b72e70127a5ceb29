"""Files of motion capture as other programs write them, for readers to read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def fall(times: np.ndarray) -> np.ndarray:
    """Positions (T, 3) [mm] of a point that falls from 2 m and drifts along x."""
    return np.stack([100 * times, 0 * times + 3, 2000 - 4905 * times**2], axis=1)


def write_trc(path: Path, markers: Sequence[str], positions: np.ndarray, times: np.ndarray, unit: str = "mm") -> None:
    """positions (T, M, 3), a gap is NaN. As OpenSim describes the format."""
    rate = (len(times) - 1) / (times[-1] - times[0])
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:.2f}\t{rate:.2f}\t{len(times)}\t{len(markers)}\t{unit}\t{rate:.2f}\t1\t{len(times)}",
        "Frame#\tTime\t" + "\t\t\t".join(markers) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{m + 1}" for m in range(len(markers)) for axis in "XYZ"),
        "",
    ]
    for k, row in enumerate(positions):
        lines.append(f"{k + 1}\t{times[k]:.6f}\t" + "\t".join(_cells(row)))
    path.write_text("\n".join(lines) + "\n")


def write_qtm(
    path: Path, markers: Sequence[str], positions: np.ndarray, times: np.ndarray, *, columns: bool = True,
    gap: str = "0.000",
) -> None:  # fmt: skip
    """positions (T, M, 3) [mm], a gap is NaN. columns: with frame, time and names of columns."""
    rate = (len(times) - 1) / (times[-1] - times[0])
    header = {
        "NO_OF_FRAMES": len(times), "NO_OF_CAMERAS": 8, "NO_OF_MARKERS": len(markers), "FREQUENCY": round(rate),
        "NO_OF_ANALOG": 0, "ANALOG_FREQUENCY": 0, "DESCRIPTION": "--", "TIME_STAMP": "2026-01-01, 12:00:00\t1.5",
        "DATA_INCLUDED": "3D", "MARKER_NAMES": "\t".join(markers),
    }  # fmt: skip
    lines = [f"{key}\t{value}" for key, value in header.items()]
    if columns:
        lines.append("Frame\tTime\t" + "\t".join(f"{name} {axis}" for name in markers for axis in "XYZ"))
    for k, row in enumerate(positions):
        start = f"{k + 1}\t{times[k]:.5f}\t" if columns else ""
        lines.append(start + "\t".join(cell or gap for cell in _cells(row)))
    path.write_text("\n".join(lines) + "\n")


def write_motive(path: Path, markers: Sequence[str], positions: np.ndarray, times: np.ndarray) -> None:
    """positions (T, M, 3) [mm], a gap is NaN. With a rigid body before the markers, and one behind that repeats the
    first marker where it should be."""
    rate = (len(times) - 1) / (times[-1] - times[0])
    count = len(markers)
    kinds = ["Rigid Body"] * 8 + ["Marker"] * 3 * count + ["Rigid Body Marker"] * 3
    names = ["Body"] * 8 + [name for name in markers for _ in range(3)] + [f"Body:{markers[0]}"] * 3
    what = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * (3 * count + 3)
    axes = [*"XYZWXYZ", "", *"XYZ" * (count + 1)]
    lines = [
        f"Format Version,1.23,Take Name,{path.stem},Capture Frame Rate,{rate:.6f},Export Frame Rate,{rate:.6f},"
        "Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global",
        "",
        ",Type," + ",".join(kinds),
        ",Name," + ",".join(names),
        ",ID," + ",".join("1" for _ in kinds),
        ",," + ",".join(what),
        "Frame,Time (Seconds)," + ",".join(axes),
    ]
    for k, row in enumerate(positions):
        body = ["0", "0", "0", "1", "7", "7", "7", "0.1"]
        lines.append(f"{k},{times[k]:.6f}," + ",".join([*body, *_cells(row), "9", "9", "9"]))
    path.write_text("\ufeff" + "\n".join(lines) + "\n", encoding="utf-8")


def _cells(row: np.ndarray) -> list[str]:
    return ["" if np.isnan(value) else f"{value:.5f}" for value in row.ravel()]
