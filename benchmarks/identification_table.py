"""The lines of benchmarks/identification.py as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SPLITS = ("observed", "future")


def tables(rows: list[Mapping[str, Any]]) -> str:
    """All tables that ``rows`` have something for."""
    fits = [row for row in rows if row["what"] == "fit"]
    parts = [fit_table(fits), parameter_table(fits), unseen_table([row for row in rows if row["what"] == "unseen"])]
    return "\n\n".join(part for part in parts if part)


def fit_table(rows: list[Mapping[str, Any]]) -> str:
    """A line a fit, ``observed / future`` in a cell."""
    if not rows:
        return ""
    lines = [
        "| scene | law | Chamfer (floor) [10³ mm²] | tracked [mm] | PSNR [dB] | SSIM | box on black: PSNR [dB] "
        "| box: SSIM | box in scene: PSNR [dB] | identify [s] |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: (row["scene"], bool(variant(row)), row["law"], row["seed"])):
        cells = [
            f"{both(row, 'chamfer_1e3mm2', '.3f')} ({row['floor']:.3f})",
            both(row, "tracked_error_mm", ".1f"),
            both(row, "psnr_db", ".1f"),
            both(row, "ssim", ".3f"),
            both(row, "psnr_box_db", ".1f"),
            both(row, "ssim_box", ".3f"),
            both(row, "psnr_box_in_scene_db", ".1f"),
            "–" if row["law"] == "reference" else f"{row['seconds']['identify']:.0f}",
        ]
        law = row["fitted"] if row["law"] == "true" else row["law"]
        if row["law"] in ("auto", "reference"):
            law = f"{row['law']}: {row['fitted']}"
        lines.append(f"| {row['scene']} | {', '.join([law, *variant(row)])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def variant(row: Mapping[str, Any]) -> list[str]:
    """What sets a fit apart from the plain one of its scene and law."""
    said = [] if row["geometry_loss"] == "trajectory" else [f"geometry: {row['geometry_loss']}"]
    said += [] if row["silhouette"] else ["no silhouette"]
    said += [f"seed {row['seed']}"] if row["seed"] else []
    said += ["also " + ", ".join(row["also"])] if row.get("also") else []
    return said + list(row["settings"])


def both(row: Mapping[str, Any], name: str, form: str) -> str:
    """``observed / future``."""
    values = [row.get(split, {}).get(name) for split in SPLITS]
    return " / ".join("–" if value is None else format(value, form) for value in values)


def parameter_table(rows: list[Mapping[str, Any]]) -> str:
    """Recovered and true parameters, of fits whose family is the one that made the scene."""
    lines = []
    for row in (r for r in rows if r["law"] != "reference"):
        for name, entry in row["parameters"].items():
            if entry.get("true") is None:
                continue
            spread = entry.get("stderr")
            said = "–" if spread is None else f"{spread:.2g}"
            law = ", ".join([row["fitted"], *variant(row)])
            lines.append(
                f"| {row['scene']} | {law} | {name.replace('_', ' ')} [{entry['unit']}] | {entry['value']:.4g} "
                f"| {said} | {entry['true']:.4g} |"
            )
    head = "| scene | law | parameter | recovered | ± | true |\n|---|---|---|---|---|---|"
    return "\n".join([head, *dict.fromkeys(lines)]) if lines else ""


def unseen_table(rows: list[Mapping[str, Any]]) -> str:
    """A law on a recording that it was not fitted to."""
    if not rows:
        return ""
    lines = [
        "| law | fitted to | tested on | Chamfer after contact (floor) [10³ mm²] | tracked [mm] |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        found = row["after contact"]
        fitted_to = ", ".join([row["scene"], *row.get("also", [])])
        lines.append(
            f"| {row['fitted']} | {fitted_to} | {row['on']} | {found['chamfer_1e3mm2']:.3f} ({row['floor']:.3f}) "
            f"| {found['tracked_error_mm']:.1f} |"
        )
    return "\n".join(lines)
