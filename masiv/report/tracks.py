"""report.html of a scene of tracks: observed, before and after."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from masiv.report.page import Page
from masiv.report.sections.refinement import refinement_section
from masiv.report.sections.twin import twin_section
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin

COLUMNS = 2


def write_report(
    path: Path,
    tracks: Tracks,
    twin: Twin,
    runs: list[dict[str, Any]],
    curves: Mapping[str, Mapping[str, np.ndarray]],
    refined: Sequence[Mapping[str, Any]],
) -> None:
    """runs: rows with run, use and errors in mm; curves: by run, ``times`` (K,) and motions (K, M, A) [m] by name;
    refined: documents of refine, in the order of the conditions."""
    page = Page(f"Digital twin of {tracks.path.resolve().name}")
    bodies = ", ".join(tracks.bodies)
    page.note(f"Measured points, no pictures. Bodies: {bodies}. {len(tracks.runs)} runs.")
    page.heading("Numbers")
    names = [n for n in runs[0] if n not in ("run", "use")] if runs else []
    page.table(["run", "use", *names], [[r["run"], r["use"], *(r[n] for n in names)] for r in runs])
    twin_section(page, twin)
    for document in refined:
        refinement_section(page, document)
    page.heading("Motion")
    page.picture(_paths_of_markers(curves), "observed and simulated motion of each run")
    page.write(path)


def _paths_of_markers(curves: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
    """A panel a run: the axis that moves most of the point that moves most, and what is left of it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    count = len(curves)
    rows = max(1, -(-count // COLUMNS))
    figure, panels = plt.subplots(rows, COLUMNS, figsize=(11, 2.6 * rows), squeeze=False, layout="constrained")
    for panel, (name, run) in zip(panels.ravel(), curves.items(), strict=False):
        observed = run["observed"]
        _, marker, axis = np.unravel_index(int(np.abs(observed - observed[0]).argmax()), observed.shape)
        panel.plot(run["times"], observed[:, marker, axis], "k.", ms=2.5, label="observed")
        for label, color in (("before", "tab:orange"), ("after", "tab:blue")):
            if label in run:
                panel.plot(run["times"], run[label][:, marker, axis], color=color, lw=1, label=label)
        panel.set_title(name, fontsize=9)
        panel.tick_params(labelsize=7)
        panel.set_xlabel("time [s]", fontsize=8)
        panel.set_ylabel("position [m]", fontsize=8)
    for panel in panels.ravel()[count:]:
        panel.set_visible(False)
    panels[0, 0].legend(fontsize=7)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=90)
    plt.close(figure)
    return out.getvalue()
