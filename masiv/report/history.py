"""What the stages reported while they ran, kept in the run folder's ``log.csv`` for the loss curves."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from masiv.progress import Progress

NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
COUNT = re.compile(r"[0-9]{1,18}")
POINTS_PER_STAGE = 200
FRAMES = re.compile(r"(?:\bover )?\b([0-9]{1,9}) frames\b")


@dataclass(frozen=True)
class Reported:
    """What a stage reported: as many iterations and values. label: what the value is, with its unit. frames: over how
    many frames it was taken each time, None if the stage does not say."""

    iterations: list[int]
    values: list[float]
    label: str
    frames: list[int] | None = None


def logged(progress: Progress, path: Path) -> Progress:
    """``progress`` that also appends stage, done, total and note to the CSV ``path``, about 200 lines a stage."""

    def report(stage: str, done: int, total: int, note: str = "") -> None:
        progress(stage, done, total, note)
        if note and (done % max(1, total // POINTS_PER_STAGE) == 0 or done == total):
            with path.open("a", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow([stage, done, total, note])

    return report


def curves(path: Path) -> dict[str, Reported]:
    """Of each stage that reported a number, the first one of its notes.

    A resumed stage repeats iterations; the last report of each counts. A stage whose reports are of different things,
    such as candidates one after the other, has no curve. A line that is no report does not count.
    """
    if not path.is_file():
        return {}
    found: dict[str, dict[int, tuple[float, int | None]]] = {}
    labels: dict[str, set[str]] = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.reader(line.replace("\0", "") for line in file):
            note = row[3].split(",")[0] if len(row) == 4 and COUNT.fullmatch(row[1]) else ""
            match = NUMBER.search(note)
            if match is not None:
                over = FRAMES.search(row[3])
                found.setdefault(row[0], {})[int(row[1])] = float(match[0]), int(over[1]) if over else None
                labels.setdefault(row[0], set()).add(" ".join(NUMBER.sub("", FRAMES.sub("", note)).split()))
    return {
        stage: _reported(values, next(iter(labels[stage])))
        for stage, values in found.items()
        if len(values) > 2 and len(labels[stage]) == 1
    }


def _reported(values: dict[int, tuple[float, int | None]], label: str) -> Reported:
    order = sorted(values)
    frames = [values[k][1] for k in order]
    known = [count for count in frames if count is not None]
    label = "distance [mm]" if label == "mm" else label
    return Reported(order, [values[k][0] for k in order], label, known if len(known) == len(frames) else None)
