"""One table and one page of a batch: a row for each run, with its settings, state, time and errors."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from masiv.batch.plan import Stage
from masiv.batch.run import FAILED, state_of
from masiv.batch.spec import Job
from masiv.files import write_text
from masiv.report.page import Page, number

COLUMNS = {
    "run": "run", "scene": "scene", "law": "law", "seed": "seed", "variant": "variant", "state": "state",
    "minutes": "time [min]", "found_law": "law found", "fit_mm": "fit [mm]", "held_out_mm": "held out [mm]",
    "tracked_observed_mm": "to truth, observed [mm]", "tracked_future_mm": "to truth, future [mm]",
    "psnr_future_db": "PSNR, future [dB]", "effects": "effects", "refine": "refine",
    "validation_before_mm": "validation before [mm]", "validation_after_mm": "validation after [mm]",
    "message": "message",
}  # fmt: skip
"""Keys of a row, in the order of the table, and their headings."""
TABLE, PAGE = "batch.csv", "batch.html"
MOST_PARAMETERS = 4
"""Of a law whose values a row gives."""


def rows_of(
    jobs: Sequence[Job], stages: Sequence[Stage], record: Mapping[str, Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """A row for each job, with the keys of ``COLUMNS`` that are known of it. record: of ``masiv.batch.run.Record``."""
    by_key = {stage.key: stage for stage in stages}
    rows = []
    for job in jobs:
        own = _with_shared([s for s in stages if s.run == job.name], by_key)
        results = {stage.name: record.get(stage.key, {}) for stage in own}
        data = {name: result.get("data", {}) for name, result in results.items()}
        failed = [r["message"] for r in results.values() if r.get("state") == FAILED]
        row: dict[str, Any] = {
            "run": job.name, "scene": job.scene.name, "law": job.law, "seed": job.seed, "variant": job.variant or None,
            "state": state_of(own, record), "minutes": sum(r.get("seconds", 0.0) for r in results.values()) / 60,
            "message": failed[0] if failed else None,
        }  # fmt: skip
        row |= _identified(data.get("identify", {}))
        row |= _evaluated(data.get("evaluate", {}))
        row |= _refined(data.get("refine", {}))
        rows.append(row)
    return rows


def _with_shared(own: Sequence[Stage], by_key: Mapping[str, Stage]) -> list[Stage]:
    """The stages of a run and those that they follow on, which it may share with others."""
    out: dict[str, Stage] = {}
    waiting = list(own)
    while waiting:
        stage = waiting.pop()
        out[stage.key] = stage
        waiting += [by_key[key] for key in stage.after if key not in out]
    return list(out.values())


def _at(data: Any, *keys: str) -> Any:
    """The value under nested keys; None if there is none."""
    for key in keys:
        data = data.get(key) if isinstance(data, Mapping) else None
    return data


def _identified(data: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {
        "fit_mm": _at(data, "metrics", "fit", "trajectory_rmse_mm"),
        "psnr_future_db": _at(data, "metrics", "twin", "future", "psnr_box_db"),
    }
    law = data.get("law")
    if law:
        values = [f"{name} {number(row['value'])} {row['unit']}" for name, row in law["parameters"].items()]
        out["found_law"] = ", ".join([law["kind"], *values]) if len(values) <= MOST_PARAMETERS else law["kind"]
    for use, key in (("fit", "fit_mm"), ("hold_out", "held_out_mm")):
        errors = [run["before_mm"] for run in data.get("runs", []) if run.get("use") == use and "before_mm" in run]
        if errors:
            out[key] = sum(errors) / len(errors)
    return out


def _evaluated(data: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"tracked_{part}_mm": _at(data, "motion", "twin", part, "tracked_error_mm") for part in ("observed", "future")
    }


def _refined(data: Mapping[str, Any]) -> dict[str, Any]:
    if not data:
        return {}
    return {
        "refine": data["verdict"],
        "effects": ", ".join(dict.fromkeys(term["effect"] for term in data["accepted"])) or None,
        "validation_before_mm": _at(data, "before", "validation", "trajectory_rmse_mm"),
        "validation_after_mm": _at(data, "after", "validation", "trajectory_rmse_mm"),
    }


def used_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys of ``COLUMNS`` that any of the rows has a value of."""
    return [key for key in COLUMNS if any(row.get(key) is not None for row in rows)]


def write_table(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """All columns as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_page(title: str, rows: Sequence[Mapping[str, Any]], path: Path, reports: Mapping[str, str]) -> None:
    """The page: the table, and links to ``reports``, name of the run -> address."""
    page = Page(title)
    states = [row["state"] for row in rows]
    page.text(", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)) + f" of {len(rows)} runs.")
    columns = used_columns(rows)
    page.table([COLUMNS[key] for key in columns], [[row.get(key) for key in columns] for row in rows])
    if reports:
        page.heading("Reports")
        page.links(list(reports.items()))
    page.write(path)


def as_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table for a terminal, without the columns that are the same in all rows or too long."""
    columns = [key for key in used_columns(rows) if key not in ("scene", "law", "seed", "variant", "found_law")]
    cells = [[COLUMNS[key] for key in columns], *([number(row.get(key)) for key in columns] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(columns))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in cells)
