"""Does something hold the body? A force that carries its weight is seldom one that acts from afar."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

MOST = 0.5
"""Part of the weight above which a steady force is more likely a support than wind or another gravity."""
WITHIN = 3.0
"""Standard errors by which a force that cancels gravity may differ from it: once in 370 draws it differs by more."""
FORCE, SCALE = "body_force", "gravity_scale"


def carried_weight(effect: str, values: Mapping[str, float], gravity: np.ndarray | None) -> float | None:
    """Part of the weight, at least ``MOST``, that a steady ``effect`` with ``values`` carries, by parameter name;
    ``gravity`` (3,) [m/s^2] in the axes of the effect. None if it carries less, is no such effect, or there is no
    gravity."""
    weights = _parts(effect, values, gravity)
    carried = sum(weights[name] * values[name] for name in weights)
    return carried if carried >= MOST else None


def carried_weight_stderr(effect: str, stderr: Mapping[str, float | None], gravity: np.ndarray | None) -> float | None:
    """Standard error of ``carried_weight`` by those of the parameters, taken as independent; None if one is not
    known."""
    parts = [(weight, stderr[name]) for name, weight in _parts(effect, stderr, gravity).items() if weight != 0]
    if not parts or any(error is None or not np.isfinite(error) for _, error in parts):
        return None
    return float(np.sqrt(sum((weight * (error or 0.0)) ** 2 for weight, error in parts)))


def question(carried: float, stderr: float | None = None) -> str:
    """What a force means that carries the part ``carried`` of the weight, known to ``stderr``."""
    if stderr is not None and abs(1 - carried) <= WITHIN * stderr < carried:
        return (
            f"it carries {100 * carried:.0f} ± {100 * stderr:.1g} % of the weight, so it cancels gravity within its "
            "error: the body is held or supported by something that is not declared"
        )
    return (
        f"it carries {100 * carried:.0f} % of the weight: is the body held, hung or supported by something that the "
        "scene does not declare?"
    )


def _parts(effect: str, names: Iterable[str], gravity: np.ndarray | None) -> dict[str, float]:
    """By parameter, the part of the weight that a unit of it carries; empty if ``effect`` is no steady force."""
    size = 0.0 if gravity is None else float(np.linalg.norm(gravity))
    if gravity is None or not size > 0:
        return {}
    if effect == FORCE:
        axes = {n: "xyz".index(n.removeprefix("acceleration_")[0]) for n in names if n.startswith("acceleration_")}
        return {name: -float(gravity[axis]) / size**2 for name, axis in axes.items()}
    return {n: -1.0 for n in names if n.startswith("relative_change")} if effect == SCALE else {}
