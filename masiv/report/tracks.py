"""report.html of a scene of tracks: observed, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from masiv.identifiability.held_tracks import held_problems
from masiv.report.charts import BLACK, BLUE, COLOURS, ORANGE, Chart, Line
from masiv.report.motion_view import Motion
from masiv.report.page import Page
from masiv.report.sections.answer import Agreement, answer_cards
from masiv.report.sections.player import player_section
from masiv.report.sections.refinement import refinement_section
from masiv.report.sections.twin import fit_table, twin_section
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin

MODELS = {"before": ORANGE, "after": BLUE}
GROWTH = (
    "The twin starts as observed and is never corrected, so what is wrong with it adds up: an error that grows with "
    "time is what to expect. Its slope says how fast the twin and the body part."
)
USES = {"fit": "fitted", "hold_out": "held out: used to choose, not to fit", "test": "test: seen by no fit or choice"}


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
    page.note(f"Measured points, no pictures. Bodies: {bodies}. {len(tracks.runs)} recordings.")
    for problem in held_problems(tracks):
        page.note(f"Problem: {problem}.")
    added = any(document["accepted"] for document in refined)
    page.cards(answer_cards(twin, None, refined, [] if added else _agreements(runs)))
    if curves:
        player_section(
            page, _motions(curves, runs), twin.up, in_space=_along_three_axes(curves), beside=_all_errors(curves)
        )
        page.heading("Motion of each recording")
        page.note(
            "The marker and axis that move most, and the error over all markers. Before refine: the twin as "
            "identified; after: with what refine added."
        )
        page.charts([chart for name, run in curves.items() for chart in _charts(name, run)])
    for document in refined:
        refinement_section(page, document)
    twin_section(page, twin)
    page.heading("Numbers and settings")
    names = [n for n in runs[0] if n not in ("run", "use")] if runs else []
    header = ["recording", "use", *(f"{n.removesuffix('_mm')} [mm, RMS]" for n in names)]
    page.table(header, [[r["run"], USES.get(r["use"], r["use"]), *(r.get(n) for n in names)] for r in runs])
    with page.folded("Notes of the fit"):
        fit_table(page, twin)
        page.note("All settings: run.yaml. The twin: twin.yaml. The motions: rollout.npz.")
    page.write(path)


def _agreements(runs: Sequence[Mapping[str, Any]]) -> list[Agreement]:
    """The RMS over the recordings of each use, the strictest use first."""
    found = []
    for use in ("test", "hold_out", "fit"):
        rows = [r for r in runs if r["use"] == use]
        if not rows:
            continue
        mean = {
            name: float(np.sqrt(np.mean([r[name] ** 2 for r in rows])))
            for name in ("before_mm", "after_mm")
            if all(r.get(name) is not None for r in rows)
        }
        on = f"RMS over {len(rows)} recording{'s' if len(rows) > 1 else ''}, {USES[use]}"
        if mean:
            error = mean.get("after_mm", mean.get("before_mm", 0.0))
            found.append(Agreement(error, on, mean.get("before_mm") if "after_mm" in mean else None))
    return found


def _along_three_axes(curves: Mapping[str, Mapping[str, np.ndarray]]) -> bool:
    return all(run["observed"].shape[2] == 3 for run in curves.values())


def _motions(curves: Mapping[str, Mapping[str, np.ndarray]], runs: Sequence[Mapping[str, Any]]) -> list[Motion]:
    """A motion for each recording and model; axes that were not measured are zero."""
    use = {row["run"]: str(USES.get(row["use"], row["use"])).partition(":")[0] for row in runs}
    found = []
    for name, run in curves.items():
        for model in reversed([m for m in MODELS if m in run]):
            label = name if "after" not in run else f"{name}, {model} refine"
            parts = [(len(run["times"]), use.get(name, ""))]
            found.append(Motion(label, run["times"], _in_space(run[model]), _in_space(run["observed"]), parts))
    return found


def _all_errors(curves: Mapping[str, Mapping[str, np.ndarray]]) -> Chart:
    """Of the twin, of each recording."""
    lines = []
    for k, (name, run) in enumerate(curves.items()):
        dash = ("solid", "dash", "dot")[k // len(COLOURS) % 3]
        made = run.get("after", run["before"])
        lines.append(Line(name, run["times"], _rms_mm(made, run["observed"]), COLOURS[k % len(COLOURS)], dash))
    return Chart("Error of the twin", "time [s]", "RMS over points [mm]", lines, GROWTH, time=True, from_zero=True)


def _rms_mm(made: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """(T,) [mm] over points, of motions (T, M, A) [m]."""
    return 1e3 * np.sqrt(np.nanmean(((made - observed) ** 2).sum(2), axis=1))


def _in_space(places: np.ndarray) -> np.ndarray:
    return np.pad(places.astype(np.float64), ((0, 0), (0, 0), (0, 3 - places.shape[2])))


def _charts(name: str, run: Mapping[str, np.ndarray]) -> list[Chart]:
    """The axis that moves most of the point that moves most, and the error over all points."""
    observed, times = run["observed"], run["times"]
    _, marker, axis = np.unravel_index(int(np.nanargmax(np.abs(observed - observed[0]))), observed.shape)
    shown = {label: colour for label, colour in MODELS.items() if label in run}
    place = f"{'xyz'[axis]} [m]" if observed.shape[2] == 3 else "position [m]"
    path = [Line("observed", times, observed[:, marker, axis], BLACK, points=True)]
    path += [Line(_label(m, run), times, run[m][:, marker, axis], colour) for m, colour in shown.items()]
    error = [Line(_label(m, run), times, _rms_mm(run[m], observed), colour) for m, colour in shown.items()]
    return [
        Chart(f"{name}: marker {marker}", "time [s]", place, path, time=True),
        Chart(f"{name}: error", "time [s]", "RMS over points [mm]", error, time=True, from_zero=True),
    ]


def _label(model: str, run: Mapping[str, np.ndarray]) -> str:
    return f"{model} refine" if "after" in run else "twin"
