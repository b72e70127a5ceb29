"""The twin as a section of the report: initial state, surroundings, law, effects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from masiv.report.page import Page
from masiv.twin.twin import VOLUME_ERROR

if TYPE_CHECKING:
    from masiv.twin import Twin


def twin_section(page: Page, twin: Twin) -> None:
    """Quantities with units and standard errors. Initial states of bodies of tracks, one an observation, are in
    twin.yaml."""
    page.heading("The twin")
    page.table(["quantity", "value", "unit", "standard error"], _rows(twin))
    effects_table(page, twin)


def _rows(twin: Twin) -> list[list[Any]]:
    rows: list[list[Any]] = []
    free = [body for body in twin.bodies if body.particles is not None and not body.clamps]
    if len(free) == len(twin.bodies) == 1:
        rows += [
            ["initial velocity", twin.velocity.tolist(), "m/s", None],
            ["initial spin", twin.omega.tolist(), "rad/s", None],
        ]
    rows.append(["gravity", twin.gravity.tolist(), "m/s²", None])
    for body in twin.bodies:
        label = f" of {body.name}" if len(twin.bodies) > 1 else ""
        rows += [
            [f"volume{label}", float(body.volume), "m³", twin.fit.get(VOLUME_ERROR)],
            [f"density{label} (given, not identified)", float(body.density), "kg/m³", None],
        ]
    rows.append(
        ["ground height", None if twin.boundary.ground is None else float(twin.boundary.ground.height), "m", None]
    )
    rows.append(["contact", twin.boundary.contact, "", None])
    law: Mapping[str, Any] = {"kind": "rigid"} if twin.rigid else twin.law.description()
    rows.append(["law", law["kind"], "", None])
    for name, row in law.get("parameters", {}).items():
        rows.append([name.replace("_", " "), row["value"], row["unit"], row.get("stderr")])
    return rows


def fit_table(page: Page, twin: Twin) -> None:
    """What the fit noted of itself: keys of ``fit`` in twin.yaml."""
    fit = twin.fit if "refined" not in twin.fit else twin.fit["refined"]  # the rest is of the law before
    rows = [[name.replace("_", " "), value] for name, value in fit.items() if name not in ("history", VOLUME_ERROR)]
    if rows:
        page.table(["key of twin.yaml, fit", "value"], rows)


def effects_table(page: Page, twin: Twin) -> None:
    """What acts on the twin in addition to its law, gravity and ground."""
    from masiv.effects.catalogue import effect_named

    if not twin.effects:
        return
    rows = []
    for effect in twin.effects:
        scope = [", ".join(effect.bodies) or "all bodies", effect.condition or "all observations"]
        name = effect.name.replace("_", " ")
        looks_like = effect_named(effect.name).looks_like
        rows += [[name, *scope, looks_like, p.replace("_", " "), v, u, e] for p, v, u, e in effect.rows()]
        if effect.place is not None:
            rows.append([name, *scope, looks_like, "place in the body", list(effect.place), "m", None])
    page.table(["effect", "bodies", "condition", "looks like", "parameter", "value", "unit", "standard error"], rows)
    page.note("Axes of effects: y up (along the ground's normal), the ground at y = 0. A dash: not known.")
