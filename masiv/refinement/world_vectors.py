"""Vectors and places of an effect along the axes of the world: effects act in the axes of the simulation."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from masiv.effects.directions import direction
from masiv.models.base import EffectTerm
from masiv.scene.transforms import SimulationFrame

COMPONENT = re.compile(r"^(?:(?P<stem>.+)_)?(?P<axis>[xyz])(?P<body> of .+)?$")
"""``acceleration_x``, or ``x`` of a place; of one of several bodies."""
PLACE, AXIS, INCLINATION, DIRECTION = "place", "axis", "inclination", "direction"


def vectors_in_world(
    term: EffectTerm, values: Mapping[str, float], errors: Mapping[str, float], axes: SimulationFrame
) -> dict[str, Any]:
    """Of ``term``, by name: ``value`` (3,), ``stderr`` (3,) or None, ``unit``; components of an error are taken as
    independent. A place without a height is that of a vertical axis: then ``axis`` is its direction, without a unit. So
    is ``direction`` for an inclination (``masiv.effects.directions``). Empty if the effect has none of these."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for p in term.parameters:
        found = COMPONENT.match(p.name.removeprefix(f"{term.name}."))
        if found:
            key = found["stem"] or PLACE, found["body"] or ""
            groups.setdefault(key, {})[found["axis"]] = p.name
    out: dict[str, Any] = {}
    for (stem, body), names in groups.items():
        unit = next(term.units[n] for n in names.values())
        turned = axes.points_to_world if stem == PLACE else axes.vectors_to_world
        out[f"{stem}{body}"] = _entry(names, values, errors, unit, turned, axes)
        if stem == PLACE and "y" not in names:
            upwards = axes.vectors_to_world(np.array([0.0, 1.0, 0.0]))
            out[f"{AXIS}{body}"] = {"value": upwards.tolist(), "stderr": None, "unit": "1"}
        if stem == INCLINATION:
            unit_vector = direction(torch.tensor([values[names["x"]], values[names["z"]]], dtype=torch.float64))
            turned_vector = axes.vectors_to_world(unit_vector.numpy())
            out[f"{DIRECTION}{body}"] = {"value": turned_vector.tolist(), "stderr": None, "unit": "1"}
    return out


def _entry(
    names: Mapping[str, str], values: Mapping[str, float], errors: Mapping[str, float], unit: str,
    turned: Callable[[np.ndarray], np.ndarray], axes: SimulationFrame,
) -> dict[str, Any]:  # fmt: skip
    def along(of: Mapping[str, float], missing: float) -> np.ndarray:
        return np.array([of.get(names[a], missing) if a in names else 0.0 for a in "xyz"])

    spread: Sequence[float] = np.sqrt(axes.rotation.T**2 @ along(errors, np.nan) ** 2).tolist()
    known = bool(np.isfinite(spread).all())
    return {"value": turned(along(values, 0.0)).tolist(), "stderr": list(spread) if known else None, "unit": unit}
