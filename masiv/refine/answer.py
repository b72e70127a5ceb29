"""What refine says it found, in words, from refine.json. Light: no torch, no taichi."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def answer(document: Mapping[str, Any]) -> str:
    """The verdict with what was accepted, and where the motion does not tell one cause from others, with these."""
    names = ", ".join(map(_named, document["accepted"]))
    if not names:
        return document["verdict"]
    beside = ", beside what was added" if document["verdict"] == "unexplained residual" else ""
    return f"{document['verdict']}{beside}: {names}"


def _named(entry: Mapping[str, Any]) -> str:
    others = entry.get("or_else")
    if not others:
        return words(entry["effect"])
    return f"one of {', '.join(map(words, [entry['effect'], *others]))} (this motion does not tell which)"


def words(name: str) -> str:
    """A name of the code for people."""
    return name.replace("_", " ")
