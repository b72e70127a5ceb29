"""The report's picture of a discrepancy force: when, where and which way."""

from __future__ import annotations

import numpy as np

from masiv.report.plots import BLUE, GREEN, GREY, ORANGE, new_figure, shade_parts, to_png


def force_in_time_and_space(
    force: np.ndarray, places: np.ndarray, times: np.ndarray, fitted: int, test: int, up: np.ndarray | None = None
) -> bytes:
    """force (T, S, 3) [m/s^2] at places (T, S, 3) [m], NaN where nothing was seen, and times (T,) [s]. Left: its mean
    over the points along each axis, and its root mean square. Right: two views of it at the fitted instant where it is
    strongest, over the path of the points' middle."""
    figure, (time, *views) = new_figure(3, size=(4.9, 3.6))
    seen = ~np.isnan(force + places).max(axis=2)
    count = np.maximum(seen.sum(1), 1)
    kept = np.where(seen[:, :, None], force, 0.0)
    mean = kept.sum(1) / count[:, None]
    rms = np.sqrt((kept**2).sum((1, 2)) / count)
    shade_parts(time, times, fitted, test)
    for axis, colour in zip(range(3), (ORANGE, GREEN, BLUE), strict=True):
        time.plot(times, mean[:, axis], color=colour, label=f"mean along {'xyz'[axis]}")
    time.plot(times, rms, color=GREY, linestyle="--", label="RMS over points")
    time.axhline(0, color=GREY, linewidth=0.6)
    time.set(xlabel="time [s]", ylabel="force per mass [m/s²]")
    time.legend(frameon=False, fontsize=7)

    strongest = int(rms[:fitted].argmax()) if fitted else 0
    here = seen[strongest]
    middle = np.where(seen[:, :, None], places, 0.0).sum(1)[seen.any(1)] / count[seen.any(1), None]
    longest = float(np.linalg.norm(kept[strongest], axis=1).max())
    upright = 1 if up is None else int(np.abs(up).argmax())
    for view, across in zip(views, (axis for axis in range(3) if axis != upright), strict=True):
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
        view.set_title(f"at {times[strongest]:.2f} s; longest arrow {longest:.3g} m/s²", fontsize=9)
        if up is not None and up[upright] < 0:
            view.invert_yaxis()
    return to_png(figure)
