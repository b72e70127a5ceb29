"""Does something hold the body? A force that carries its weight is seldom one that acts from afar."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

MOST = 0.5
"""Part of the weight above which a steady force is more likely a support than wind or another gravity."""
FORCE, SCALE = "body_force", "gravity_scale"


def carried_weight(effect: str, values: Mapping[str, float], gravity: np.ndarray | None) -> float | None:
    """Part of the weight, at least ``MOST``, that a steady ``effect`` with ``values`` carries, by parameter name;
    ``gravity`` (3,) [m/s^2] in the axes of the effect. None if it carries less, is no such effect, or there is no
    gravity."""
    if gravity is None or not np.linalg.norm(gravity) > 0:
        return None
    size = float(np.linalg.norm(gravity))
    if effect == FORCE:
        force = np.array([next(v for n, v in values.items() if n.startswith(f"acceleration_{a}")) for a in "xyz"])
        carried = -float(force @ gravity) / size**2
    elif effect == SCALE:
        carried = -next(v for n, v in values.items() if n.startswith("relative_change"))
    else:
        return None
    return carried if carried >= MOST else None


def question(carried: float) -> str:
    return (
        f"it carries {100 * carried:.0f} % of the weight: is the body held, hung or supported by something that the "
        "scene does not declare?"
    )
