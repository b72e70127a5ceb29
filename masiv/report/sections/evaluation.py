"""Errors against the true motion, if ``masiv evaluate`` was run, as a section of the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.report.numbers import rows
from masiv.report.page import Page
from masiv.strict import read_json

KNOWN = {"trajectory": "observed motion", "twin": "twin"}


def read_evaluation(path: Path) -> dict[str, Any] | None:
    """evaluate.json of a run of pictures, or None where there is none. Raises InputError if it cannot be read."""
    if not path.is_file():
        return None
    found = read_json(path)
    if not isinstance(found, dict) or "motion" not in found:
        raise InputError(f"{path} was not written by this version of masiv: delete it and run masiv evaluate again")
    return found


def true_errors(evaluation: Mapping[str, Any] | None) -> list[tuple[str, np.ndarray, list[float]]]:
    """Tracked errors [mm] over frames: name, frames, values."""
    found = []
    for key, name in KNOWN.items():
        blocks = [b for b in ((evaluation or {}).get("motion", {}).get(key) or {}).values() if b]
        if blocks:
            frames = np.array([frame for b in blocks for frame in b["frames"]], dtype=int)
            found.append((name, frames, [value for b in blocks for value in b["tracked_error_mm_by_frame"]]))
    return found


def evaluation_section(page: Page, evaluation: Mapping[str, Any]) -> None:
    page.heading("Against the true motion")
    header, body = rows(evaluation["motion"])
    used = [k for k, _ in enumerate(header) if any(row[k] is not None for row in body)]
    page.table([header[k] for k in used], [[row[k] for k in used] for row in body])
    page.note(
        f"masiv evaluate, {evaluation['truth']['particles']} true particles. Tracked: mean distance of each particle "
        "from the true place of its material. The rigid bodies are baselines without any deformation. Chamfer "
        f"distances below {evaluation['chamfer_floor_1e3mm2']:.2g} · 10³ mm² are sampling alone."
    )
