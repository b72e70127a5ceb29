"""Plots of the report, each a function to PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

BLUE, ORANGE, GREEN, GREY = "#2563a8", "#d97706", "#2f855a", "#8a8f98"


def _figure(columns: int = 1) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, columns, figsize=(5.2 * columns, 3.2), squeeze=False, layout="constrained")
    for axis in axes[0]:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes[0]


def _png(figure: Any) -> bytes:
    from matplotlib import pyplot

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    pyplot.close(figure)
    return buffer.getvalue()


def loss_curves(curves: Mapping[str, tuple[Sequence[int], Sequence[float], str]]) -> bytes:
    """One panel a stage: its reported number over iterations; logarithmic where all are positive."""
    figure, axes = _figure(len(curves))
    for axis, (stage, (iterations, values, label)) in zip(axes, curves.items(), strict=True):
        axis.plot(iterations, values, color=BLUE)
        axis.set(title=stage, xlabel="iteration", ylabel=label[:40] or "reported value")
        if min(values) > 0 and max(values) > 3 * min(values):
            axis.set_yscale("log")
    return _png(figure)


def centroid_path(
    motions: Mapping[str, tuple[np.ndarray, np.ndarray]], up: np.ndarray, fit_until: float | None
) -> bytes:
    """Height and horizontal travel of the centroid over time. ``motions``: name -> (positions (T, Q, 3) [m], times)."""
    figure, (height, travel) = _figure(2)
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
    return _png(figure)


def over_frames(
    curves: Mapping[str, tuple[Sequence[int], Sequence[float | None]]], title: str, unit: str, fit: int
) -> bytes:
    """Curves over frames; ``fit`` is the number of fitted frames."""
    figure, (axis,) = _figure(1)
    for colour, (name, (frames, values)) in zip((BLUE, ORANGE, GREEN, GREY), curves.items(), strict=False):
        shown = [np.nan if value is None else value for value in values]
        axis.plot(frames, shown, color=colour, label=name, marker="o", markersize=3)
    axis.set(title=title, xlabel="frame", ylabel=unit)
    _mark_fit(axis, fit - 0.5, "end of the fit")
    axis.legend(frameon=False)
    return _png(figure)


def law_curves(law: Any) -> bytes:
    """Kirchhoff stress [kPa] of a ``masiv.materials.law.Law`` in uniaxial stretch, in shear and under volume change."""
    import torch

    amount = torch.linspace(-0.25, 0.25, 51, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).repeat(len(amount), 1, 1)
    stretch, shear, volume = eye.clone(), eye.clone(), eye * (1 + amount)[:, None, None] ** (1 / 3)
    stretch[:, 0, 0] += amount
    shear[:, 0, 1] += amount
    figure, axes = _figure(3)
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
    return _png(figure)


def material_curves(curves: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Stress over strain, a panel a curve of ``masiv.materials.describe.Material``; grey beyond what was observed."""
    figure, axes = _figure(len(curves))
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
    return _png(figure)


def _mark_fit(axis: Any, where: float | None, label: str) -> None:
    if where is not None:
        axis.axvline(where, color=GREY, linestyle="--", linewidth=1)
        axis.text(where, axis.get_ylim()[1], f" {label}", color=GREY, fontsize=8, va="top")
