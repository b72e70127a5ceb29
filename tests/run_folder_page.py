"""docs/run_folder.md against the files of a run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

TEXT = (Path(__file__).parents[1] / "docs/run_folder.md").read_text(encoding="utf-8")


def _names(row: str) -> set[str]:
    return {name.rstrip("/") for name in re.findall(r"`([^`]+)`", row)}


def files_of_the_page() -> set[str]:
    """What the first table names, folders without their slash."""
    table = TEXT.split("\n## ")[0]
    return {name for row in table.splitlines() if row.startswith("| `") for name in _names(row)}


def keys_of_the_page(file: str, kind: str = "") -> set[str]:
    """Keys of ``file`` of a run of ``kind`` (pictures, tracks), by the rows below its name."""
    found: set[str] = set()
    current = False
    for row in TEXT.splitlines():
        cells = row.split("|")
        if len(cells) > 3 and cells[1].strip():
            owner = cells[1].strip()
            current = owner == f"`{file}`" or (bool(kind) and owner == f"`{file}` of {kind}")
        if len(cells) > 3 and current:
            found |= _names(cells[2])
    return found


def section(title: str) -> str:
    return next(part for part in TEXT.split("\n## ") if part.startswith(title))


def missing(run: Path, kind: str) -> list[str]:
    """Files and keys of ``run`` that the page does not name."""
    out = []
    for path in sorted(p for p in run.rglob("*") if p.is_file()):
        name = str(path.relative_to(run))
        if name.split("/")[0] in ("checkpoints", "masks"):
            continue
        if not {name, path.name} & files_of_the_page():
            out.append(name)
        documented = keys_of_the_page(path.name.replace(".dry_run", ""), kind)
        out += [f"{name}: {key}" for key in _keys(path) if key not in documented]
    record: dict[str, Any] = yaml.safe_load((run / "run.yaml").read_text())
    in_record = _names(section("run.yaml"))
    inner = [key for part in ("split", "stages", "config") for key in record[part]]
    stages = [key for stage in record["stages"].values() for key in stage]
    return out + [f"run.yaml: {key}" for key in [*record, *inner, *stages] if key not in in_record]


def _keys(path: Path) -> list[str]:
    if path.suffix == ".json":
        return list(json.loads(path.read_text()))
    if path.suffix != ".npz":
        return []
    owner = "O" if path.name.startswith("refine") else "RUN"
    with np.load(path) as file:
        keys = [re.sub("@.+", f"@{owner}", key) for key in file]
    return [re.sub("^network/.+", "network/NAME", key) for key in keys]
