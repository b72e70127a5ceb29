"""Plots of the report, each a function to PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

BLUE, ORANGE, GREEN, GREY = "#2563a8", "#d97706", "#2f855a", "#8a8f98"


def new_figure(columns: int = 1, rows: int = 1, size: tuple[float, float] = (5.2, 3.2)) -> tuple[Any, Any]:
    """A figure of panels of ``size`` [inches], and its axes: of the one row, or (rows, columns)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    whole = (size[0] * columns, size[1] * rows)
    figure, axes = pyplot.subplots(rows, columns, figsize=whole, squeeze=False, layout="constrained")
    for axis in axes.flat:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes[0] if rows == 1 else axes


def to_png(figure: Any) -> bytes:
    from matplotlib import pyplot

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    pyplot.close(figure)
    return buffer.getvalue()


def loss_curves(curves: Mapping[str, tuple[Sequence[int], Sequence[float], str]]) -> bytes:
    """One panel a stage: its reported number over iterations; logarithmic where all are positive."""
    figure, axes = new_figure(len(curves))
    for axis, (stage, (iterations, values, label)) in zip(axes, curves.items(), strict=True):
        axis.plot(iterations, values, color=BLUE)
        axis.set(title=stage, xlabel="iteration", ylabel=label[:40] or "reported value")
        if min(values) > 0 and max(values) > 3 * min(values):
            axis.set_yscale("log")
    return to_png(figure)


def centroid_path(
    motions: Mapping[str, tuple[np.ndarray, np.ndarray]], up: np.ndarray, fit_until: float | None
) -> bytes:
    """Height and horizontal travel of the centroid over time. ``motions``: name -> (positions (T, Q, 3) [m], times)."""
    figure, (height, travel) = new_figure(2)
    for colour, (name, (positions, times)) in zip((BLUE, ORANGE, GREEN, GREY), motions.items(), strict=False):
        centre = positions.mean(axis=1, dtype=np.float64)
        along = centre @ up
        across = np.linalg.norm((centre - centre[0]) - np.outer(along - along[0], up), axis=1)
        height.plot(times, along, color=colour, label=name, marker="o", markersize=3)
        travel.plot(times, across, color=colour, label=name, marker="o", markersize=3)
    height.set(title="height of the centroid", xlabel="time [s]", ylabel="along up [m]")
    travel.set(title="horizontal travel of the centroid", xlabel="time [s]", ylabel="distance from the start [m]")
    for axis in (height, travel):
        _mark_fit(axis, fit_until, "last fitted frame")
    height.legend(frameon=False)
    return to_png(figure)


def over_frames(
    curves: Mapping[str, tuple[Sequence[int], Sequence[float | None]]], title: str, unit: str, fit: int
) -> bytes:
    """Curves over frames; ``fit`` is the number of fitted frames."""
    figure, (axis,) = new_figure(1)
    for colour, (name, (frames, values)) in zip((BLUE, ORANGE, GREEN, GREY), curves.items(), strict=False):
        shown = [np.nan if value is None else value for value in values]
        axis.plot(frames, shown, color=colour, label=name, marker="o", markersize=3)
    axis.set(title=title, xlabel="frame", ylabel=unit)
    _mark_fit(axis, fit - 0.5, "end of the fit")
    axis.legend(frameon=False)
    return to_png(figure)


def law_curves(law: Any) -> bytes:
    """Kirchhoff stress [kPa] of a ``masiv.materials.law.Law`` in uniaxial stretch, in shear and under volume change."""
    import torch

    amount = torch.linspace(-0.25, 0.25, 51, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).repeat(len(amount), 1, 1)
    stretch, shear, volume = eye.clone(), eye.clone(), eye * (1 + amount)[:, None, None] ** (1 / 3)
    stretch[:, 0, 0] += amount
    shear[:, 0, 1] += amount
    figure, axes = new_figure(3)
    panels = (
        ("stretch of one axis, others held", "stretch − 1", stretch, (0, 0)),
        ("simple shear", "shear", shear, (0, 1)),
        ("change of volume", "J − 1", volume, (0, 0)),
    )
    kind = next((parameter.dtype for parameter in law.parameters()), torch.float64)
    for axis, (title, label, gradients, (row, column)) in zip(axes, panels, strict=True):
        with torch.no_grad():
            stress = law.stress(gradients.to(kind))[:, row, column].double().numpy() / 1e3
        axis.plot(amount.numpy(), stress, color=BLUE)
        axis.set(title=title, xlabel=label, ylabel="Kirchhoff stress [kPa]")
        axis.axhline(0, color=GREY, linewidth=0.7)
    return to_png(figure)


def material_curves(curves: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Stress over strain, one panel for each curve of ``describe.Material``; grey beyond the observed range."""
    figure, axes = new_figure(len(curves))
    for axis, (name, curve) in zip(axes, curves.items(), strict=True):
        strain, stress = np.asarray(curve["strain"]), np.asarray(curve["stress_pa"]) / 1e3
        low, high = curve["observed"]
        seen = (strain >= low) & (strain <= high)
        axis.plot(strain, stress, color=GREY, linewidth=1)
        axis.plot(strain, np.where(seen, stress, np.nan), color=BLUE, linewidth=2, label="identified, observed")
        if curve["family_pa"] is not None:
            family = np.asarray(curve["family_pa"]) / 1e3
            axis.plot(strain, family, color=ORANGE, linewidth=1, linestyle="--", label="nearest classical law")
        axis.set(title=name.replace(", there", ",\nthere"), xlabel="strain", ylabel="Kirchhoff stress [kPa]")
        axis.axhline(0, color=GREY, linewidth=0.5)
    axes[0].legend(frameon=False, fontsize=8)
    return to_png(figure)


def residual_in_time(
    curves: Mapping[str, np.ndarray], times: np.ndarray, fitted: int, test: int, noise_mm: float
) -> bytes:
    """Residuals. curves: name -> (K, N, 3) [m] at ``times`` (K,) [s], of which the first ``fitted`` were fitted and the
    last ``test`` are for the test."""
    figure, (axis,) = new_figure(1, size=(7.2, 3.4))
    half = shade_parts(axis, times, fitted, test)
    axis.axhline(noise_mm, color=GREY, linestyle="--", linewidth=1.2, label="noise floor")
    for colour, (name, field) in zip((ORANGE, BLUE), curves.items(), strict=False):
        rms = 1e3 * np.sqrt((field.astype(np.float64) ** 2).sum(2).mean(1))
        axis.plot(times, rms, color=colour, label=name, marker="o", markersize=3)
    axis.set(xlabel="time [s]", ylabel="residual, RMS over particles [mm]", xlim=(times[0] - half, times[-1] + half))
    axis.set_ylim(bottom=0)
    figure.legend(frameon=False, fontsize=8, loc="outside right center")
    return to_png(figure)


def shade_parts(axis: Any, times: np.ndarray, fitted: int, test: int) -> float:
    """Shade the instants ``times`` (K,) [s] that were fitted, those for validation and the last ``test`` ones for the
    test. Returns half the interval [s]."""
    half = (times[1] - times[0]) / 2 if len(times) > 1 else times[0] / 2
    edges = [0, fitted, len(times) - test, len(times)]
    parts = (("fitted", BLUE, 0.07), ("validation", ORANGE, 0.12), ("test", GREY, 0.2))
    for first, last, (label, colour, alpha) in zip(edges[:-1], edges[1:], parts, strict=True):
        if first < last:
            begin, end = times[first] - half, times[last - 1] + half
            axis.axvspan(begin, end, color=colour, alpha=alpha, linewidth=0, label=label)
    return half


ARROW_CELLS = 7
"""Cells along the longer side of the body, over each of which an arrow is the mean."""


def residual_in_space(
    fields: Mapping[str, np.ndarray], positions: np.ndarray, times: np.ndarray, up: np.ndarray | None = None
) -> bytes:
    """Where residuals are: a row for each of ``fields`` (name -> (K, N, 3) [m]), two views of ``positions`` (N, 3) [m].

    Colour: RMS over instants, one scale for all rows, the largest on top. Arrows: the mean over a cell at the row's
    worst instant, the longest of a row as long as a cell. up (3,): the axis nearest to it is drawn upwards; y without.
    """
    size = {name: 1e3 * np.linalg.norm(field.astype(np.float64), axis=2) for name, field in fields.items()}
    colour = {name: np.sqrt((found**2).mean(0)) for name, found in size.items()}
    top = max(float(np.quantile(found, 0.99)) for found in colour.values())
    upright = 1 if up is None else int(np.abs(up).argmax())
    level = [axis for axis in range(3) if axis != upright]
    extent = np.ptp(positions, axis=0)
    height = 4.0 * float(extent[upright] / max(extent[level].max(), 1e-9)) + 0.9
    figure, panels = new_figure(2, len(fields), size=(4.9, min(max(height, 2.2), 6.0)))
    shown = None
    for row, (name, field) in zip(np.reshape(panels, (-1, 2)), fields.items(), strict=True):
        worst = int((size[name] ** 2).mean(1).argmax())
        means = [_cell_means(positions[:, [across, upright]], field[worst][:, [across, upright]]) for across in level]
        longest = max(float(np.linalg.norm(arrows, axis=1).max()) for _, arrows, _ in means)
        for axis, across, (places, arrows, cell) in zip(row, level, means, strict=True):
            order = colour[name].argsort()
            points = positions[order][:, [across, upright]].T
            shown = axis.scatter(*points, c=colour[name][order], s=7, linewidths=0, cmap="viridis", vmin=0, vmax=top)
            axis.quiver(
                *places.T, *arrows.T, angles="xy", scale_units="xy", scale=max(longest, 1e-12) / (1.2 * cell),
                color="white", edgecolor="#1c2430", linewidth=0.6, width=0.006, zorder=3,
            )  # fmt: skip
            axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[upright]} [m]", aspect="equal")
            axis.margins(0.12)
            axis.set_title(f"{name}; arrows at {times[worst]:.2f} s, longest {1e3 * longest:.3g} mm", fontsize=9)
            if up is not None and up[upright] < 0:
                axis.invert_yaxis()
    figure.colorbar(shown, ax=panels, label="residual of a particle, RMS over time [mm]", extend="max", shrink=0.8)
    return to_png(figure)


def _cell_means(points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means of ``points`` (N, 2) and of ``values`` (N, 2) over square cells, and the side of a cell."""
    low = points.min(0)
    side = max(float(np.ptp(points, axis=0).max()) / ARROW_CELLS, 1e-9)
    cells = np.minimum(((points - low) / side).astype(int), ARROW_CELLS - 1)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()

    def mean(of: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, of[:, k]) for k in range(2)], axis=1) / count[:, None]

    return mean(points), mean(values), side


def _mark_fit(axis: Any, where: float | None, label: str) -> None:
    if where is not None:
        axis.axvline(where, color=GREY, linestyle="--", linewidth=1)
        axis.text(where, axis.get_ylim()[1], f" {label}", color=GREY, fontsize=8, va="top")
