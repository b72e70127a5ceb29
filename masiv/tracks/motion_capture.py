"""Text files of motion capture: TRC (Motion Analysis, OpenSim), TSV of Qualisys Track Manager, CSV of OptiTrack Motive.

Light: no torch, no taichi.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.strict import quoted
from masiv.tracks.point_table import Table

_UNITS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), "cm"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
}
_GAPS = ("", "nan", "null")
MOTIVE_FIRST_CELL = "Format Version"

Row = tuple[int, list[str]]
"""Line in the file, counted from 1, and its cells."""


def read_trc(path: Path) -> Table:
    """Points of a TRC file (tab-separated). An empty cell is a gap. Raises InputError if it cannot be read."""
    rows = _rows(path, "\t")
    names = next((k for k, (_, row) in enumerate(rows) if row[0].lower() == "frame#"), None)
    if names is None or names < 2:
        raise InputError(f"{path} is not a TRC file: it has no row that begins with Frame#")
    keys, values = rows[names - 2][1], rows[names - 1][1]
    header = dict(zip(keys, values, strict=False))
    markers = tuple(name for name in rows[names][1][2:] if name)
    data = [(line, row) for line, row in rows[names + 2 :] if row[0]]
    _require_frames(path, len(data), header.get("NumFrames"))
    positions = _positions(path, data, markers, first=2)
    times = _column(path, data, 1)
    return _table(path, markers, positions, times, header.get("DataRate"), header.get("Units"))


def read_qtm_tsv(path: Path) -> Table:
    """3D points of a TSV file of Qualisys Track Manager, in millimetres. A gap is empty, NULL, or zero in all three
    coordinates, as the program writes it. Raises InputError if it cannot be read."""
    rows = _rows(path, "\t")
    header = {row[0]: row[1:] for _, row in rows if row[0].isupper()}
    markers = tuple(name for name in header.get("MARKER_NAMES", ()) if name)
    if not markers:
        raise InputError(f"{path} has no row MARKER_NAMES: export it from QTM as TSV with its header")
    if (kind := next(iter(header.get("DATA_INCLUDED", ())), "3D")) != "3D":
        raise InputError(f"{path} has {quoted(kind)} data: export 3D data")
    data = [(line, row) for line, row in rows if _is_number(row[0]) or row[0].lower() in _GAPS]
    _require_frames(path, len(data), next(iter(header.get("NO_OF_FRAMES", ())), None))
    columns = [row for _, row in rows if row[0].lower() == "frame"]
    first = 2 if columns and len(columns[0]) > 1 and columns[0][1].lower() == "time" else 0
    positions = _positions(path, data, markers, first=first)
    positions[(positions == 0).all(axis=2)] = np.nan
    times = _column(path, data, 1) if first else None
    rate = next(iter(header.get("FREQUENCY", ())), None)  # EXT with an external clock
    return _table(path, markers, positions, times, rate if rate and _is_number(rate) else None, "mm")


def is_motive_csv(path: Path) -> bool:
    """Whether the CSV file is an export of OptiTrack Motive, by its first cell."""
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf").startswith(MOTIVE_FIRST_CELL.encode())


def read_motive_csv(path: Path) -> Table:
    """Measured markers of a CSV export of OptiTrack Motive. An empty cell is a gap; rigid bodies, bones and where their
    markers should be are not read. Raises InputError if it cannot be read."""
    rows = _rows(path, ",")
    start = next((k for k, (_, row) in enumerate(rows) if row[0].lower() == "frame"), None)
    if start is None or start < 3:
        raise InputError(f"{path} has no row that begins with Frame: export it from Motive with its header")
    names_of_columns = rows[start][1]
    header = dict(zip(rows[0][1][::2], rows[0][1][1::2], strict=False))
    labels = {row[1].lower(): row for _, row in rows[1:start] if len(row) > 1 and not row[0] and row[1]}
    if not {"type", "name"} <= labels.keys():
        raise InputError(f"{path} lacks the rows Type and Name: export it from Motive with its header")
    what = rows[start - 1][1]
    wide = len(names_of_columns)
    kinds, names, what = (row + [""] * (wide - len(row)) for row in (labels["type"], labels["name"], what))
    first = [
        k for k in range(2, wide - 2)
        if kinds[k].lower() == "marker" and what[k].lower() == "position"
        and [c.lower() for c in names_of_columns[k : k + 3]] == ["x", "y", "z"]
    ]  # fmt: skip
    data = [(line, row) for line, row in rows[start + 1 :] if row[0]]
    _require_frames(path, len(data), None)
    markers = tuple(names[k] for k in first)
    positions = _positions(path, data, markers, first=first)
    times = _column(path, data, 1)
    rate = header.get("Export Frame Rate") or header.get("Capture Frame Rate")
    return _table(path, markers, positions, times, rate, header.get("Length Units"))


def _rows(path: Path, separator: str) -> list[Row]:
    """Lines that are not empty; cells without blanks around them."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(
                file, delimiter=separator, quoting=csv.QUOTE_MINIMAL if separator == "," else csv.QUOTE_NONE
            )
            rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as text in columns: {error}") from error
    return [(line, row) for line, row in rows if any(row) or len(row) > 1]  # a row of gaps is a row


def _require_frames(path: Path, found: int, said: str | None) -> None:
    if not found:
        raise InputError(f"{path} has no rows of data under its header")
    if said is not None and _is_number(said) and float(said) > found:
        raise InputError(f"{path} is cut short: its header says {said} frames, there are {found}: copy it anew")


def _positions(path: Path, data: Sequence[Row], markers: Sequence[str], *, first: int | Sequence[int]) -> np.ndarray:
    """Positions (T, M, 3). first: the column of each marker's x, or that of the first, with the others behind it."""
    if not markers:
        raise InputError(f"{path} has no markers")
    if len(set(markers)) < len(markers):
        twice = next(name for name in markers if list(markers).count(name) > 1)
        raise InputError(f"{path}: two markers are named {quoted(twice)}: give each its own name")
    starts = [first + 3 * m for m in range(len(markers))] if isinstance(first, int) else first
    out = np.full((len(data), len(markers), 3), np.nan)
    for t, (line, row) in enumerate(data):
        if len(row) > max(starts) + 3 and isinstance(first, int) and any(row[max(starts) + 3 :]):
            raise InputError(f"{path}: row {line} has {len(row)} cells, more than its {len(markers)} markers need")
        for m, k in enumerate(starts):
            for axis in range(3):
                cell = row[k + axis] if k + axis < len(row) else ""  # gaps at the end may be left out
                out[t, m, axis] = _number(path, line, cell)
    out[np.isnan(out).any(axis=2)] = np.nan
    return out


def _column(path: Path, data: Sequence[Row], k: int) -> np.ndarray:
    return np.array([_number(path, line, row[k] if k < len(row) else "") for line, row in data])


def _number(path: Path, line: int, cell: str) -> float:
    if cell.lower() in _GAPS:
        return math.nan
    if not _is_number(cell):
        raise InputError(f"{path}: row {line}: {quoted(cell)} is not a finite number")
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _table(
    path: Path, markers: tuple[str, ...], positions: np.ndarray, times: np.ndarray | None, rate: str | None,
    unit: str | None,
) -> Table:  # fmt: skip
    """Times follow from ``rate`` [Hz] if the file has none."""
    hertz = float(rate) if rate and _is_number(rate) else None
    if hertz is not None and hertz <= 0:
        raise InputError(f"{path}: its rate is {rate} Hz, it must be positive")
    if times is None and hertz is not None:
        times = np.arange(len(positions)) / hertz
    return Table(markers, positions, times, hertz, _UNITS.get((unit or "").lower()))
