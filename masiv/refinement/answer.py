"""The verdict of refine in words, from refine.json. Light: no torch, no taichi."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

SCHEMA = 5
"""Of refine.json. A document of another one is not read."""


def answer(document: Mapping[str, Any]) -> str:
    """The verdict with what was accepted, and, if the motion does not distinguish an effect from others, with these.
    If it cannot be told, what is probable: the 95 % credible set."""
    names = ", ".join(map(_with_others, document["accepted"]))
    if not names:
        sets = document["credible_set"] if document["verdict"] == "cannot tell" else []
        told = [f"{together(s['effects'])} {s['probability']:.2g}" for s in sets]
        return f"{document['verdict']}: {', '.join(told)}" if len(told) > 1 else document["verdict"]
    added = ", although an effect was added" if document["verdict"] == "unexplained residual" else ""
    return f"{document['verdict']}{added}: {names}"


def together(terms: Sequence[str]) -> str:
    """Terms that act at once, for people: effects, with whom each acts on if not on all."""
    told = [(words(effect), scope) for effect, _, scope in (term.partition("@") for term in terms)]
    return " and ".join(f"{name} ({scope})" if scope else name for name, scope in told) or "no effect"


def advice(document: Mapping[str, Any]) -> str | None:
    """What hides an effect, and what to do, if it cannot be told and errors as large as the residual are expected: of
    the observation, or of the simulation's grid, whichever is larger; else None."""
    observation, grid = (document[key]["fit"] or 0.0 for key in ("observation_error_mm", "discretization_mm"))
    if document["verdict"] != "cannot tell" or max(observation, grid) < document["residual_mm"]["fit"]:
        return None
    if grid > observation:
        return (
            "what another grid of the simulation would change is as large as the residual: more particles may tell "
            "(refine.particles; of tracks, tracks.particles)"
        )
    return (
        "the expected error of the observation is as large as the residual: more cameras, a finer texture or a "
        "stronger motion may tell"
    )


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
