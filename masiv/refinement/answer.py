"""The verdict of refine in words, from refine.json. Light: no torch, no taichi."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def answer(document: Mapping[str, Any]) -> str:
    """The verdict with what was accepted, and, if the motion does not distinguish an effect from others, with these."""
    names = ", ".join(map(_with_others, document["accepted"]))
    if not names:
        return document["verdict"]
    added = ", although an effect was added" if document["verdict"] == "unexplained residual" else ""
    return f"{document['verdict']}{added}: {names}"


def _with_others(entry: Mapping[str, Any]) -> str:
    others = entry.get("indistinguishable_from")
    if not others:
        return words(entry["effect"])
    return f"one of {', '.join(map(words, [entry['effect'], *others]))} (this motion does not distinguish them)"


def words(name: str) -> str:
    """A name of the code for people."""
    return name.replace("_", " ")


def outcome(row: Mapping[str, Any]) -> str:
    """What became of a refit, in words."""
    if row["accepted"]:
        return "accepted"
    if row["impossible"]:
        return "; ".join(row["impossible"])
    factor = row["log_bayes_factor"]
    known = "" if factor is None else f"log Bayes factor {factor:.1f}"
    if row.get("not_weighed"):
        known = f"not weighed: {row['not_weighed']}"
    if not row["converged"]:
        known += ", not converged" if known else "not converged"
    return known or "not weighed"
