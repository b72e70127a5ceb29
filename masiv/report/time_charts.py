"""Charts over the time of a recording, and over the iterations of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from masiv.report.charts import BLUE, COLOURS, GREY, ORANGE, Band, Chart, Line, parts_of_time
from masiv.report.history import Reported


def over_time(
    curves: Mapping[str, tuple[Sequence[float] | np.ndarray, Sequence[float | None] | np.ndarray]],
    title: str, y: str, bands: Sequence[Band] = (), *, note: str = "", from_zero: bool = True,
    levels: Sequence[tuple[float, str]] = (),
) -> Chart:  # fmt: skip
    """curves: name -> (times [s], values)."""
    lines = [
        Line(name, times, values, colour)
        for colour, (name, (times, values)) in zip(COLOURS, curves.items(), strict=False)
    ]
    return Chart(title, "time [s]", y, lines, note, bands, levels, time=True, from_zero=from_zero)


def centroid_charts(
    motions: Mapping[str, tuple[np.ndarray, np.ndarray]], up: np.ndarray, bands: Sequence[Band]
) -> list[Chart]:
    """Height and horizontal travel of the centroid. ``motions``: name -> (positions (T, Q, 3) [m], times (T,) [s])."""
    height, travel = {}, {}
    for name, (positions, times) in motions.items():
        centre = positions.mean(axis=1, dtype=np.float64)
        along = centre @ up
        height[name] = times, along
        travel[name] = times, np.linalg.norm((centre - centre[0]) - np.outer(along - along[0], up), axis=1)
    return [
        over_time(height, "Height of the centroid", "along up [m]", bands, from_zero=False),
        over_time(travel, "Horizontal travel of the centroid", "distance from the start [m]", bands),
    ]


def residual_in_time(
    curves: Mapping[str, np.ndarray], times: np.ndarray, fitted: int, test: int, noise_mm: float, note: str = ""
) -> Chart:
    """Residuals. curves: name -> (K, N, 3) [m] at ``times`` (K,) [s], of which the first ``fitted`` were fitted and the
    last ``test`` are for the test."""
    lines = [
        Line(name, times, 1e3 * np.sqrt((field.astype(np.float64) ** 2).sum(2).mean(1)), colour)
        for colour, (name, field) in zip((ORANGE, BLUE), curves.items(), strict=False)
    ]
    return Chart(
        "Residual over time", "time [s]", "RMS over particles [mm]", lines, note,
        parts_of_time(times, fitted, test), [(noise_mm, "noise floor")], time=True, from_zero=True,
    )  # fmt: skip


def force_in_time(force: np.ndarray, places: np.ndarray, times: np.ndarray, fitted: int, test: int) -> Chart:
    """force (T, S, 3) [m/s^2] at places (T, S, 3) [m], NaN where nothing was seen: its mean over the points along each
    axis, and its root mean square."""
    seen = ~np.isnan(force + places).max(axis=2)
    count = np.maximum(seen.sum(1), 1)
    kept = np.where(seen[:, :, None], force, 0.0)
    mean, rms = kept.sum(1) / count[:, None], np.sqrt((kept**2).sum((1, 2)) / count)
    lines = [Line(f"mean along {'xyz'[axis]}", times, mean[:, axis], COLOURS[axis]) for axis in range(3)]
    lines.append(Line("RMS over points", times, rms, GREY, "dash"))
    bands = parts_of_time(times, fitted, test)
    return Chart("The force over time", "time [s]", "force per mass [m/s²]", lines, bands=bands, time=True)


def convergence(stage: str, reported: Reported) -> Chart:
    """What a stage reported over its iterations; a part for each number of frames that it compared, if it said it."""
    values = reported.values
    bands: list[Band] = []
    lines = [Line(stage, reported.iterations, values)]
    note = ""
    if reported.frames is not None and len(set(reported.frames)) > 1:
        lines = []
        for shade, (frames, rows) in enumerate(groupby(zip(reported.frames, reported.iterations, values, strict=True),
                                                       key=lambda row: row[0])):  # fmt: skip
            own = list(rows)
            lines.append(Line(f"{frames} frames", [r[1] for r in own], [r[2] for r in own], BLUE, listed=False))
            bands.append(Band(own[0][1] - 0.5, own[-1][1] + 0.5, str(frames), GREY, 0.08 + 0.12 * (shade % 2), False))
        note = (
            "The number on top says how many frames are compared, by turns shaded: the fit starts with the first ones "
            "and adds later ones as it goes. More frames leave more time for errors to grow, so each that is added "
            "lifts the curve. That is no divergence: within a band it should fall or stay."
        )
    positive = min(values) > 0 and max(values) > 10 * min(values)
    return Chart(stage, "iteration", reported.label or "reported value", lines, note, bands, log=positive,
                 from_zero=not positive)  # fmt: skip
