"""What ``masiv refine`` found, as a section of the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.files import read_npz
from masiv.refinement.answer import SCHEMA, answer, outcome, words
from masiv.refinement.support import question
from masiv.report import plots
from masiv.report.force_plot import force_in_space
from masiv.report.page import Page, Share, number
from masiv.report.quantities import percent
from masiv.report.time_charts import force_in_time, residual_in_time
from masiv.strict import read_json

REFINED, FIELDS = "refine.json", "refine.npz"
PARTS = {"fit": "fitted", "validation": "validation", "test": "test"}
"""Of the instants, in words."""
FORCE = ("force", "force_places")
"""Arrays of refine.npz that are there if there is a discrepancy force."""
METRICS = {
    "trajectory_rmse_mm": ("distance to the observed motion, RMS", "mm"),
    "chamfer_1e3mm2": ("chamfer distance to the observed motion", "10³ mm²"),
    "psnr_db": ("PSNR against the video", "dB"),
    "psnr_box_in_scene_db": ("PSNR in the mask's box, background drawn", "dB"),
    "ssim": ("SSIM against the video", ""),
    "mask_iou": ("overlap of masks (IoU)", ""),
}


def read_refined(run: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """refine.json and refine.npz of the run folder, None if it lacks one. Raises InputError if they cannot be read."""
    if not (run / REFINED).is_file() or not (run / FIELDS).is_file():
        return None
    try:
        document = read_json(run / REFINED)
        file = read_npz(run / FIELDS)
        first = str(file["observations"][0])
        names = ("before", "after", "observed", "points", "times", "fit_count", "test_count")
        fields = {name: file[f"{name}@{first}"] for name in names}
        fields |= {name: file[f"{name}@{first}"] for name in FORCE if f"{name}@{first}" in file}
    except (InputError, KeyError, IndexError) as error:
        raise InputError(f"{run / REFINED} and {FIELDS} cannot be read ({error}): run masiv refine again") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(f"{run / REFINED} is of another version of masiv: run masiv refine again")
    return document, fields


def refinement_section(
    page: Page,
    document: Mapping[str, Any],
    fields: Mapping[str, np.ndarray] | None = None,
    up: np.ndarray | None = None,
) -> None:
    """What ``document`` (refine.json) says. fields: arrays of refine.npz, drawn in time and space if given. up (3,):
    upwards in the world, for the views."""
    title = "Closing the loop: what does the model lack?"
    page.heading(f"{title} Condition {document['condition']}" if document.get("condition") else title)
    page.text(_verdict(document))
    if fields is not None:
        _figures(page, document, fields, up)
    _causes(page, document["candidates"])
    _limits(page, document["upper_limits"])
    _refits(page, document["rounds"])
    _before_after(page, document["before"], document["after"])
    _accepted(page, document["accepted"])
    _bodies(page, document.get("bodies") or {})
    _unexplained(page, document["unexplained"])
    if document["discrepancy_force"] is not None:
        _discrepancy_force(page, document["discrepancy_force"], fields, up)
    _next_experiment(page, document.get("next_experiment"))


def _bodies(page: Page, bodies: Mapping[str, Any]) -> None:
    if not bodies:
        return
    page.subheading("By body, on observations for validation")
    page.table(
        ["body", "verdict", "effects", "before [mm]", "after [mm]"],
        [
            [name, b["verdict"], ", ".join(b["effects"]), b["validation_mm"]["before"], b["validation_mm"]["after"]]
            for name, b in bodies.items()
        ],
    )


def _verdict(document: Mapping[str, Any]) -> str:
    laws = document["laws"]
    law = words(laws["before"])
    if laws["after"] != laws["before"]:
        law += f", then {words(laws['after'])}"
    errors = [
        f"{label} {_change(_mm(document['before'], split), _mm(document['after'], split))} mm"
        for split, label in PARTS.items()
        if document["before"].get(split)
    ]
    return (
        f"Verdict: {answer(document)}. Residual (simulated less observed) on "
        f"{', on '.join(errors)}; noise floor of the observation {number(document['noise_floor_mm'])} mm. "
        f"{_probabilities(document)}"
        f"Classical law with its best parameters: {law}. {document['rollouts']} rollouts.{_grid(document)}"
    )


def _change(before: str, after: str) -> str:
    return before if before == after else f"{before} → {after}"


def _probabilities(document: Mapping[str, Any]) -> str:
    p, unknown = document["null_probability"], document["unknown_probability"]
    check, test = document["predictive_p"]["after"], document["test"].get("after")
    expected = "" if test is None else f"The final model expects {number(test['expected_rmse_mm'])} mm on the test. "
    return (
        f"Probability that no effect acts: {percent(p)}; that something unknown acts: {percent(unknown)}; of so "
        f"large a residual with nothing more missing: {percent(check)}. {expected}"
    )


def _grid(document: Mapping[str, Any]) -> str:
    """How much of what finer grids change is in the motion that the residual is of; nothing if none was fitted."""
    share = document["grid_change"]["after"]
    if share is None:
        return ""
    return f" Simulated with few particles; {number(share)} of what finer grids change on average is added."


def _mm(errors: Mapping[str, Any], split: str) -> str:
    return number(errors.get(split, {}).get("trajectory_rmse_mm"))


def _figures(page: Page, document: Mapping[str, Any], fields: Mapping[str, np.ndarray], up: np.ndarray | None) -> None:
    added = bool(document["accepted"])
    names = ("before", "after") if added else ("before",)
    shown = {name if added else "without effects": fields[name] for name in names}
    times = fields["times"]
    note = (
        "The gap between the curves is what the added effect explains. Frames for validation are not fitted and take "
        "part in the choice of effects; nothing has seen those of the test. What stays above the dashed line is no "
        "noise."
        if added
        else "A curve near the dashed line leaves nothing to explain; one that grows away from it is missing physics."
    )
    counts = int(fields["fit_count"]), int(fields["test_count"])
    page.charts([residual_in_time(shown, times, *counts, document["noise_floor_mm"], note)])
    page.pictures(plots.residual_in_space(shown, fields["points"], times, up))
    page.note(
        "Particles at frame 0. An even colour is an error of the whole body, a bright spot one of a part; arrows point "
        "from the observed to the simulated position."
    )


def _causes(page: Page, candidates: Sequence[Mapping[str, Any]]) -> None:
    page.subheading("Causes, ranked")
    if not candidates:
        page.note("None was looked for: the residual is too near the noise floor.")
        return
    page.table(
        ["effect", "explains alone", "strength", "unit", "standard error", "probability", "what it does in a video"],
        [
            [
                _name(c),
                Share(c["explained"]),
                _number(c["theta"]),
                _unit(c["unit"]),
                _number(c["stderr"]),
                _number(c["probability"]),
                c["looks_like"],
            ]
            for c in candidates
        ],
    )
    page.note(
        "Share of the residual that one effect explains, after initial velocity, stiffness and ground have absorbed "
        "what they can (score test, first order: a shortlist, the refits decide). Probability: of the model with "
        "it, after the refits; a dash if it was not fitted."
    )


def _limits(page: Page, limits: Sequence[Mapping[str, Any]]) -> None:
    if not limits:
        return
    page.subheading("What is excluded")
    page.table(
        ["effect", "95 % upper limit", "unit", "motion at the limit [mm]", "this recording can tell"],
        [
            [
                _name(x),
                _number(x["strength"]),
                _unit(x["unit"]),
                _number(x["motion_mm"]),
                "yes" if x["determined"] else f"no: {x['reason']}" if x.get("reason") else "no",
            ]
            for x in sorted(limits, key=lambda x: not x["determined"])
        ],
    )
    page.note(
        "An effect that is not named is weaker than its limit, with 95 % probability. The limit is of a linear model."
    )


def _refits(page: Page, rounds: Sequence[Mapping[str, Any]]) -> None:
    rows = []
    for turn, done in enumerate(rounds, start=1):
        for refit in done["refits"]:
            values = ", ".join(f"{words(n)} {number(_number(q['value']))}" for n, q in refit["parameters"].items())
            rows.append([
                turn, ", ".join(map(words, [*done["base"]["effects"], _name(refit)])), words(refit["law"]),
                _number(refit["fit_rmse_mm"]), _number(refit["validation_rmse_mm"]),
                _number(refit["log_bayes_factor"]), values, outcome(refit),
            ])  # fmt: skip
    if not rows:
        return
    page.subheading("Refits that competed")
    page.table(
        [
            "round",
            "effects",
            "law",
            "fitted [mm]",
            "validation [mm]",
            "log Bayes factor",
            "values",
            "outcome",
        ],
        rows,
    )
    page.note("Each was fitted through the rollout together with the law's parameters and the initial state.")


def _before_after(page: Page, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    page.subheading("Before and after")
    splits = [split for split in PARTS if before.get(split)]
    keys = [*METRICS, *sorted({k for s in splits for k in before[s]} - METRICS.keys() - {"frames"})]
    rows = []
    for key in keys:
        cells = [_number(errors[split].get(key)) for split in splits for errors in (before, after)]
        if any(cell is not None for cell in cells):
            rows.append([*METRICS.get(key, (words(key), "")), *cells])
    page.table(["quantity", "unit", *(f"{PARTS[s]}, {when}" for s in splits for when in ("before", "after"))], rows)
    frames = [f"{PARTS[s]}: {_span(before[s]['frames'])}" for s in splits if before[s].get("frames")]
    if frames:
        page.note(f"Frames {'; '.join(frames)}. Before: the best model without effects, not the learnt law.")


def _span(frames: Sequence[int]) -> str:
    return f"{frames[0]} to {frames[-1]}" if len(frames) > 1 else str(frames[0])


def _accepted(page: Page, accepted: Sequence[Mapping[str, Any]]) -> None:
    if not accepted:
        return
    page.subheading("What was added")
    page.table(
        ["effect", "parameter", "value", "standard error", "unit", "may be in its place"],
        [
            [
                _name(a),
                words(n),
                _number(value),
                _number(a["stderr"].get(n)),
                _unit(a["unit"].get(n, "")),
                ", ".join(map(words, a.get("indistinguishable_from", []))) or None,
            ]
            for a in accepted
            for n, value in a["theta"].items()
        ],
    )
    page.note("Axes of effects: y up (along the ground's normal), the ground at y = 0. A dash: not known.")
    for a in accepted:
        if a.get("carried_weight") is not None:
            page.note(f"{_name(a)}: {question(a['carried_weight'], a.get('carried_weight_stderr'))}")
    rows = [
        [_name(a), words(n), q["value"], q["stderr"], _unit(q["unit"])]
        for a in accepted
        for n, q in a.get("world", {}).items()
    ]
    if rows:
        page.table(["effect", "in the axes of the scene", "value", "standard error", "unit"], rows)


def _unexplained(page: Page, left: Mapping[str, Any]) -> None:
    page.subheading("What stays unexplained")
    page.table(
        ["quantity", "value", "unit"],
        [
            ["residual over all frames, RMS", _number(left["rmse_mm"]), "mm"],
            ["noise floor", _number(left["noise_floor_mm"]), "mm"],
            ["worst time", _number(left["worst_time_s"]), "s"],
            ["residual there, RMS", _number(left["worst_instant_rmse_mm"]), "mm"],
            ["middle of the worst tenth of the body, at frame 0", left["worst_place_at_start_m"], "m"],
            ["residual of that tenth, RMS", _number(left["worst_place_rmse_mm"]), "mm"],
        ],
    )


def _discrepancy_force(
    page: Page, force: Mapping[str, Any], fields: Mapping[str, np.ndarray] | None, up: np.ndarray | None
) -> None:
    page.subheading("A force without a known cause")
    errors = [f"{number(_number(force['fit_rmse_mm']))} mm ({PARTS['fit']})"] + [
        f"{number(_number(force[f'{part}_rmse_mm']))} mm ({PARTS[part]})"
        for part in ("validation", "test")
        if force[f"{part}_rmse_mm"] is not None
    ]
    shares = [f"{100 * s:.0f} % ({PARTS[part]})" for part, s in force["share"].items() if s is not None]
    use = (
        "The twin has it as smooth force, to be used meanwhile; it holds for this motion alone."
        if force["in_twin"]
        else "The twin does not have it: it makes the frames for validation worse."
    )
    page.note(
        "A force that changes smoothly in time and space stands in for what no effect explains. It leaves "
        f"{', '.join(errors)}; share of the residual that it removes: {', '.join(shares)}. {use}"
    )
    if fields is not None and "force" in fields:
        counts = int(fields["fit_count"]), int(fields["test_count"])
        found = fields["force"], fields["force_places"], fields["times"]
        page.charts([force_in_time(*found, *counts)])
        page.pictures(force_in_space(*found, counts[0], up))


def _next_experiment(page: Page, proposal: Mapping[str, Any] | None) -> None:
    if proposal is None:
        return
    page.subheading("The initial state to film next")
    velocity, spin = proposal["initial_velocity"], proposal["initial_omega"]
    page.note(
        f"{' and '.join(map(words, proposal['distinguishes']))} look alike in this motion "
        f"({number(_number(proposal['present_difference_mm']))} mm apart). With an initial velocity of "
        f"{number(velocity['value'])} {velocity['unit']} and a spin of {number(spin['value'])} {spin['unit']} they "
        f"would be {number(_number(proposal['predicted_difference_mm']))} mm apart."
    )


def _name(row: Mapping[str, Any]) -> str:
    """An effect and whom it acts on."""
    scope = row.get("scope", "all")
    return words(row["effect"]) if scope == "all" else f"{words(row['effect'])} ({scope})"


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit.replace("^2", "²")
