"""Files of measured points: which reader a file gets, CSV and C3D. Light: no torch, no taichi."""

from __future__ import annotations

import contextlib
import csv
import io
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.strict import quoted, shortened
from masiv.tracks.declaration import ColumnsDeclaration
from masiv.tracks.motion_capture import is_motive_csv, read_motive_csv, read_qtm_tsv, read_trc
from masiv.tracks.point_table import Table

_POSITION = re.compile(r"^(?P<marker>.+?)[ _.:](?P<axis>[xyzXYZ])(?:[ _]?[\[(]?(?P<unit>mm|cm|m)[\])]?)?$")
_UNIT = re.compile(r"[ _]?[\[(]?(?P<unit>mm|cm|m)[\])]?$")
_TIME = re.compile(r"^(time|t)(?:[ _]?[\[(]?(?P<unit>s|ms)[\])]?)?$", re.IGNORECASE)


def read_table(path: Path, columns: ColumnsDeclaration | None, select: Mapping[str, str | int | float]) -> Table:
    """The points of a file, by its ending: CSV (also as Motive writes it), C3D, TRC, TSV of QTM. Raises InputError if
    it cannot be read."""
    ending = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a regular file: correct runs.file in scene.yaml")
    if ending == ".csv" and not is_motive_csv(path):
        return read_csv(path, columns, select)
    readers = {".csv": read_motive_csv, ".c3d": read_c3d, ".trc": read_trc, ".tsv": read_qtm_tsv}
    if ending not in readers:
        raise InputError(f"{path}: tracks are read from .csv, .c3d, .trc and .tsv files: convert it to CSV")
    if select or columns is not None:
        raise InputError(f"{path}: a file of motion capture says what its columns are: leave out columns and select")
    return readers[ending](path)


def read_csv(path: Path, columns: ColumnsDeclaration | None, select: Mapping[str, str | int | float]) -> Table:
    """Points of a CSV file with one header row. An empty cell is a gap. Raises InputError.

    Columns are declared by ``columns``, or have names such as ``tip1_x_m`` and ``time_s``.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} is not a CSV file that can be read: {error}") from error
    if len(rows) < 2:
        raise InputError(f"{path} has no rows of data under its header")
    header = [name.strip() for name in rows[0]]
    if len(set(header)) < len(header):
        raise InputError(f"{path}: two columns have the same name: give each its own")
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise InputError(f"{path}: row {line} has {len(row)} cells, the header has {len(header)}")
    body = list(enumerate(rows[1:], start=2))
    for column, value in select.items():
        k = _index(path, header, column)
        body = [(line, row) for line, row in body if _same(row[k].strip(), value)]
    if not body:
        raise InputError(f"{path}: no row has {', '.join(f'{c} = {v}' for c, v in select.items())}")
    layout, units, time = _declared(columns) if columns is not None else _by_name(path, header)
    markers = tuple(layout)
    positions = np.full((len(body), len(markers), 3), np.nan)
    for m, axes in enumerate(layout.values()):
        for axis, column in axes.items():
            positions[:, m, "xyz".index(axis)] = _numbers(path, body, _index(path, header, column), column)
    if len(units) > 1:
        raise InputError(f"{path}: columns are in {' and '.join(sorted(units))}: give them one unit")
    times = None
    if time is not None:
        times = _numbers(path, body, _index(path, header, time), time)
        if _unit_of_time(time) == "ms":
            times = times / 1e3
    used = {column for axes in layout.values() for column in axes.values()} | {time} | set(select)
    ignored = () if columns is not None else tuple(name for name in header if name not in used)
    return Table(markers, positions, times, None, next(iter(units), None), ignored)


def read_c3d(path: Path) -> Table:
    """Points of a C3D file. A negative residual marks a gap. Raises InputError if it cannot be read."""
    import c3d

    try:
        with path.open("rb") as file, warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # it warns where there are no analog channels
            reader = c3d.Reader(file)
            labels = tuple(" ".join(label.split()) for label in reader.point_labels)
            unit = reader.get("POINT:UNITS")
            rate = float(reader.point_rate)
            first, last = int(reader.first_frame), int(reader.last_frame)
            frames = [np.array(points, np.float64) for _, points, _ in reader.read_frames()]
    except Exception as error:  # the library raises what it likes for a damaged file
        raise InputError(f"{path} is not a C3D file that can be read: {shortened(error)}") from error
    if len(frames) < last - first + 1:  # the library stops with a warning
        raise InputError(
            f"{path} is cut short: its header says {last - first + 1} frames, there are {len(frames)}: copy it anew"
        )
    if not frames or not labels:
        raise InputError(f"{path} has no frames or no points")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"{path}: its rate is {rate:g} Hz, it must be positive")
    points = np.stack(frames)[:, : len(labels)]
    positions = np.where(points[:, :, 3:4] < 0, np.nan, points[:, :, :3])
    name = None if unit is None else unit.string_value.strip().lower()
    times = (first - 1 + np.arange(len(frames))) / rate
    return Table(labels, positions, times, rate, name if name in ("m", "cm", "mm") else None)


def _declared(columns: ColumnsDeclaration) -> tuple[Mapping[str, Mapping[Any, str]], set[str], str | None]:
    layout = {marker: dict(axes) for marker, axes in columns.markers.items()}
    found = [_UNIT.search(column) for axes in layout.values() for column in axes.values()]
    return layout, {match["unit"] for match in found if match and match.group() != match.string}, columns.time


def _by_name(path: Path, header: list[str]) -> tuple[Mapping[str, Mapping[Any, str]], set[str], str | None]:
    layout: dict[str, dict[str, str]] = {}
    units, time = set(), None
    for column in header:
        if match := _POSITION.match(column):
            layout.setdefault(match["marker"], {})[match["axis"].lower()] = column
            if match["unit"]:
                units.add(match["unit"])
        elif time is None and _TIME.match(column):
            time = column
    axes = {axis for known in layout.values() for axis in known}
    for marker, known in layout.items():
        if lacking := sorted(axes - known.keys()):
            raise InputError(
                f"{path}: marker {marker} has no column for {', '.join(lacking)}, other markers have: add it, or name "
                "the columns under columns in scene.yaml if it was not measured"
            )
    if not layout:
        raise InputError(f"{path}: no column is named like tip1_x_m: name them so, or say columns in scene.yaml")
    return layout, units, time


def _unit_of_time(column: str) -> str:
    match = _TIME.match(column)
    return (match["unit"] or "s").lower() if match else "s"


def _index(path: Path, header: list[str], column: str) -> int:
    if column not in header:
        raise InputError(f"{path} has no column '{column}': it has {', '.join(header)}")
    return header.index(column)


def _same(cell: str, value: str | int | float) -> bool:
    if isinstance(value, str):
        return cell == value
    try:
        return float(cell) == float(value)
    except (ValueError, OverflowError):
        return False


def _numbers(path: Path, body: list[tuple[int, list[str]]], k: int, column: str) -> np.ndarray:
    out = np.full(len(body), np.nan)
    for i, (line, row) in enumerate(body):
        cell = row[k].strip()
        if cell.lower() in ("", "nan"):
            continue
        try:
            out[i] = float(cell)
        except ValueError:
            raise InputError(f"{path}: row {line}, column {column}: {quoted(cell)} is not a number") from None
        if np.isinf(out[i]):
            raise InputError(f"{path}: row {line}, column {column} is infinite: leave the cell empty for a gap")
    return out
