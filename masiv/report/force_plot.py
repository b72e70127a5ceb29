"""Where and which way a discrepancy force acts."""

from __future__ import annotations

import numpy as np

from masiv.report.charts import BLUE, GREY, ORANGE
from masiv.report.plots import new_figure, to_png


def force_in_space(
    force: np.ndarray, places: np.ndarray, times: np.ndarray, fitted: int, up: np.ndarray | None = None
) -> list[tuple[bytes, str]]:
    """force (T, S, 3) [m/s^2] at places (T, S, 3) [m], NaN where nothing was seen, and times (T,) [s]. Two views of it
    at the fitted instant where it is strongest, over the path of the points' middle, with what each shows."""
    seen = ~np.isnan(force + places).max(axis=2)
    count = np.maximum(seen.sum(1), 1)
    kept = np.where(seen[:, :, None], force, 0.0)
    rms = np.sqrt((kept**2).sum((1, 2)) / count)
    strongest = int(rms[:fitted].argmax()) if fitted else 0
    here = seen[strongest]
    middle = np.where(seen[:, :, None], places, 0.0).sum(1)[seen.any(1)] / count[seen.any(1), None]
    longest = float(np.linalg.norm(kept[strongest], axis=1).max())
    upright = 1 if up is None else int(np.abs(up).argmax())
    pictures = []
    for across in (axis for axis in range(3) if axis != upright):
        figure, view = new_figure()
        plane = [across, upright]
        view.plot(*middle[:, plane].T, color=GREY, linewidth=1, label="path of the middle")
        at, arrows = places[strongest, here][:, plane], force[strongest, here][:, plane]
        view.scatter(*at.T, s=5, color=BLUE)
        size = max(float(np.ptp(middle[:, plane], axis=0).max()), float(np.ptp(at, axis=0).max(initial=0.0)), 1e-9)
        view.quiver(
            *at.T, *arrows.T, angles="xy", scale_units="xy", scale=max(longest, 1e-12) / (0.25 * size),
            color=ORANGE, width=0.005, zorder=3,
        )  # fmt: skip
        view.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[upright]} [m]", aspect="equal")
        view.margins(0.3)
        view.set_title(f"at {times[strongest]:.2f} s; longest arrow {longest:.3g} m/s²", fontsize=10)
        if up is not None and up[upright] < 0:
            view.invert_yaxis()
        pictures.append((to_png(figure), f"discrepancy force over {'xyz'[across]} and {'xyz'[upright]}"))
    return pictures
