"""report.html of a scene of tracks: observed, before and after."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from masiv.refine.answer import answer
from masiv.report.page import Page, Share
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin

COLUMNS = 2


def write_page(
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
    page.heading("The twin")
    rows: list[list[Any]] = [["law", "rigid" if twin.rigid else twin.law.kind, "", None]]
    if not twin.rigid:
        described = twin.law.description()["parameters"]
        rows += [[n.replace("_", " "), row["value"], row["unit"], row.get("stderr")] for n, row in described.items()]
    for effect in twin.effects:
        where = ", ".join(effect.bodies) or "all"
        rows += [[f"{effect.name.replace('_', ' ')} ({where}): {n}", v, u, e] for n, v, u, e in effect.rows()]
        if effect.place is not None:
            rows.append([f"{effect.name.replace('_', ' ')}: place in the body", list(effect.place), "m", None])
    page.table(["quantity", "value", "unit", "standard error"], rows)
    for document in refined:
        _section(page, document)
    page.heading("Motion")
    page.picture(pictures(curves), "observed and simulated motion of each run")
    page.write(path)


def _section(page: Page, document: Mapping[str, Any]) -> None:
    title = "What does the model lack?"
    page.heading(f"{title} Condition {document['condition']}" if document.get("condition") else title)
    page.note(f"Verdict: {answer(document)}.")
    page.table(
        ["effect", "explained", "strength", "unit", "looks like"],
        [
            [c["effect"], Share(c["explained"]), c["theta"], c["unit"], ", ".join(c["confusable_with"])]
            for c in document["candidates"]
        ],
    )
    page.subheading("Fitted through the simulation")
    page.table(
        ["effect", "fitted runs [mm]", "held-out runs [mm]", "outcome"],
        [
            [
                t["effect"], t["fit_rmse_mm"], t["held_out_rmse_mm"],
                "accepted" if t["accepted"] else "; ".join(t["objections"]) or "another was better",
            ]
            for r in document["rounds"]
            for t in r["refits"]
        ],
    )  # fmt: skip
    if document.get("bodies"):
        page.subheading("By body, on held-out runs")
        page.table(
            ["body", "verdict", "effects", "before [mm]", "after [mm]"],
            [
                [n, b["verdict"], ", ".join(b["effects"]), b["held_out_mm"]["before"], b["held_out_mm"]["after"]]
                for n, b in document["bodies"].items()
            ],
        )


def pictures(curves: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
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
