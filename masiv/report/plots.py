"""Pictures of the report that are no charts: fields in space, as PNG bytes, all of one size."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

SIZE = (5.2, 4.2)
"""[inches]"""


def new_figure() -> tuple[Any, Any]:
    """A figure and its axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=SIZE, layout="constrained")
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    return figure, axis


def to_png(figure: Any) -> bytes:
    from matplotlib import pyplot

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    pyplot.close(figure)
    return buffer.getvalue()


ARROW_CELLS = 7
"""Cells along the longer side of the body, over each of which an arrow is the mean."""


def residual_in_space(
    fields: Mapping[str, np.ndarray], positions: np.ndarray, times: np.ndarray, up: np.ndarray | None = None
) -> list[tuple[bytes, str]]:
    """Where residuals are: two views of ``positions`` (N, 3) [m] for each of ``fields`` (name -> (K, N, 3) [m]), with
    what each shows.

    Colour: RMS over instants, one scale for all, the largest on top. Arrows: the mean over a cell at the field's
    worst instant, the longest of a field as long as a cell. up (3,): the axis nearest to it is drawn upwards, else y.
    """
    size = {name: 1e3 * np.linalg.norm(field.astype(np.float64), axis=2) for name, field in fields.items()}
    colour = {name: np.sqrt((found**2).mean(0)) for name, found in size.items()}
    top = max(float(np.quantile(found, 0.99)) for found in colour.values())
    upright = 1 if up is None else int(np.abs(up).argmax())
    level = [axis for axis in range(3) if axis != upright]
    pictures = []
    for name, field in fields.items():
        worst = int((size[name] ** 2).mean(1).argmax())
        means = [_cell_means(positions[:, [across, upright]], field[worst][:, [across, upright]]) for across in level]
        longest = max(float(np.linalg.norm(arrows, axis=1).max()) for _, arrows, _ in means)
        order = colour[name].argsort()
        for across, (places, arrows, cell) in zip(level, means, strict=True):
            figure, axis = new_figure()
            points = positions[order][:, [across, upright]].T
            shown = axis.scatter(*points, c=colour[name][order], s=7, linewidths=0, cmap="viridis", vmin=0, vmax=top)
            axis.quiver(
                *places.T, *arrows.T, angles="xy", scale_units="xy", scale=max(longest, 1e-12) / (1.2 * cell),
                color="white", edgecolor="#1c2430", linewidth=0.6, width=0.006, zorder=3,
            )  # fmt: skip
            axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[upright]} [m]", aspect="equal")
            axis.margins(0.12)
            axis.set_title(f"{name}; arrows at {times[worst]:.2f} s, longest {1e3 * longest:.3g} mm", fontsize=10)
            if up is not None and up[upright] < 0:
                axis.invert_yaxis()
            figure.colorbar(shown, ax=axis, label="residual, RMS over time [mm]", extend="max", shrink=0.9)
            pictures.append((to_png(figure), f"residual in space, {name}, over {'xyz'[across]} and {'xyz'[upright]}"))
    return pictures


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
