"""What a chart shows. report.js draws it: all of one size, with units on both axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

BLUE, ORANGE, GREEN, GREY, PURPLE, BLACK = "#2563a8", "#d97706", "#2f855a", "#8a8f98", "#7c3aed", "#1c2430"
LEVEL = "#5b6675"
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, GREY)


@dataclass(frozen=True)
class Line:
    """x, y: as many values; NaN or None breaks the line. points: marks alone. listed: in the legend."""

    name: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float | None] | np.ndarray
    colour: str = BLUE
    dash: str = "solid"
    points: bool = False
    listed: bool = True


@dataclass(frozen=True)
class Band:
    """A part of the x axis with a name, shaded. listed: the name is in the legend, else on top of the band."""

    start: float
    end: float
    name: str
    colour: str
    opacity: float = 0.12
    listed: bool = True


@dataclass(frozen=True)
class Chart:
    """x, y: labels of the axes, with units. levels: horizontal lines (value, name). time: x is the time of the
    recording [s], so the page's time slider moves a cursor in it. from_zero: the y axis starts at 0."""

    title: str
    x: str
    y: str
    lines: Sequence[Line]
    note: str = ""
    bands: Sequence[Band] = ()
    levels: Sequence[tuple[float, str]] = ()
    time: bool = False
    log: bool = False
    from_zero: bool = False

    @property
    def legend(self) -> list[tuple[str, str, str]]:
        """Kind of mark (line, dash, dot, band), colour, name."""
        lines = [line for line in self.lines if line.listed]
        shown = [(_mark(line), line.colour, line.name) for line in lines]
        if len(shown) == 1 and not self.bands and not self.levels:
            return []
        bands = [("band", f"{b.colour}{round(255 * b.opacity):02x}", b.name) for b in self.bands if b.listed]
        return [*shown, *(("dash", LEVEL, name) for _, name in self.levels), *bands]

    def data(self) -> dict[str, Any]:
        """For report.js."""
        return {
            "x": self.x, "y": self.y, "time": self.time, "log": self.log, "fromZero": self.from_zero,
            "lines": [
                {
                    "name": line.name, "x": _rounded(line.x), "y": _rounded(line.y), "colour": line.colour,
                    "dash": line.dash, "points": line.points,
                }
                for line in self.lines
            ],
            "bands": [
                {
                    "from": float(b.start), "to": float(b.end), "name": b.name, "colour": b.colour,
                    "opacity": b.opacity, "listed": b.listed,
                }
                for b in self.bands
            ],
            "levels": [{"value": float(value), "name": name} for value, name in self.levels],
        }  # fmt: skip


def parts_of_time(times: np.ndarray, fitted: int, test: int) -> list[Band]:
    """Bands of the instants ``times`` (K,) [s] that were fitted, those for validation and the last ``test`` ones for
    the test."""
    half = (times[1] - times[0]) / 2 if len(times) > 1 else times[0] / 2
    edges = [0, fitted, len(times) - test, len(times)]
    parts = (("fitted", BLUE, 0.07), ("validation", ORANGE, 0.13), ("test", GREY, 0.22))
    return [
        Band(float(times[first] - half), float(times[last - 1] + half), name, colour, opacity)
        for first, last, (name, colour, opacity) in zip(edges[:-1], edges[1:], parts, strict=True)
        if first < last
    ]


def _mark(line: Line) -> str:
    return "dot" if line.points else "line" if line.dash == "solid" else "dash"


def _rounded(values: Sequence[float | None] | np.ndarray) -> list[float | None]:
    """Five significant digits: more cannot be seen."""
    return [None if value is None or not np.isfinite(value) else float(f"{value:.5g}") for value in values]
