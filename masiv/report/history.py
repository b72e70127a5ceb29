"""What the stages reported while they ran, kept in the run folder's ``log.csv`` for the loss curves."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from masiv.progress import Progress

NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
COUNT = re.compile(r"[0-9]{1,18}")
POINTS_PER_STAGE = 200


def logged(progress: Progress, path: Path) -> Progress:
    """``progress`` that also appends stage, done, total and note to the CSV ``path``, about 200 lines a stage."""

    def report(stage: str, done: int, total: int, note: str = "") -> None:
        progress(stage, done, total, note)
        if note and (done % max(1, total // POINTS_PER_STAGE) == 0 or done == total):
            with path.open("a", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow([stage, done, total, note])

    return report


def curves(path: Path) -> dict[str, tuple[list[int], list[float], str]]:
    """For each stage that reported a number: iterations, values, and what the first number of its notes is.

    A resumed stage repeats iterations; the last report of each counts. A stage whose reports are of different things,
    such as candidates one after the other, has no curve. A line that is no report does not count.
    """
    if not path.is_file():
        return {}
    found: dict[str, dict[int, float]] = {}
    labels: dict[str, set[str]] = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.reader(line.replace("\0", "") for line in file):
            note = row[3].split(",")[0] if len(row) == 4 and COUNT.fullmatch(row[1]) else ""
            match = NUMBER.search(note)
            if match is not None:
                found.setdefault(row[0], {})[int(row[1])] = float(match[0])
                labels.setdefault(row[0], set()).add(" ".join(NUMBER.sub("", note).split()))
    return {
        stage: (sorted(values), [values[k] for k in sorted(values)], next(iter(labels[stage])))
        for stage, values in found.items()
        if len(values) > 2 and len(labels[stage]) == 1
    }
