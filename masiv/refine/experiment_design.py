"""Which throw would tell two explanations apart?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import ordered
from masiv.models.free_body import Simulation
from masiv.progress import Progress
from masiv.refine.rounds import TELLS_APART
from masiv.refine.search import SearchResult

THROWS = (
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0)),
    ((-3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 3.0, 0.0), (0.0, 0.0, 0.0)), ((2.0, 2.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.0, -3.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 1.0, 0.0), (0.0, 10.0, 0.0)), ((0.0, 1.0, 0.0), (10.0, 0.0, 0.0)),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 10.0)),
)  # fmt: skip
"""Velocities [m/s] and spins [rad/s] that a person could give a body by hand, simulation frame (y up)."""


@dataclass(frozen=True)
class Proposal:
    """velocity (3,) [m/s] and omega (3,) [rad/s], world frame, for which the two models differ most: by
    ``difference_mm``, root mean square over particles and instants; ``present_mm`` in the throw that was filmed."""

    between: tuple[str, str]
    velocity: np.ndarray
    omega: np.ndarray
    difference_mm: float
    present_mm: float


def propose(simulation: Simulation, result: SearchResult, progress: Progress) -> Proposal | None:
    """A throw between the first cause that was accepted and what may as well be there, or else the best other refit of
    that round, where the data hardly tells them apart; else None."""
    first = result.rounds[0] if result.rounds else None
    if first is None or first.accepted is None:
        return None
    best = first.accepted.fitted
    rivals = ordered([t.fitted for t in first.trials if t.fitted.model.effects != best.model.effects])
    as_well = [f for f in rivals if f.model.effects[-1] in first.indistinguishable_from]
    if not rivals:
        return None
    rival = (as_well or rivals)[0]
    alike = first.confusable.get(best.model.effects[-1], [])
    close = rival.bic(best.samples) - best.bic(best.samples) < TELLS_APART
    if not as_well and not close and rival.model.effects[-1] not in alike:
        return None
    problem = simulation.observations[0].problem
    suffix = f"@{simulation.observations[0].name}"
    frames = problem.frames

    def apart(throw: dict[str, float]) -> float:
        try:
            a, b = (simulation.positions(f.model, {**f.values, **throw}, 0, frames) for f in (best, rival))
        except NonFiniteError:
            return 0.0
        return 1e3 * float((a - b).square().sum(2).mean().sqrt())

    found = []
    for done, (velocity, omega) in enumerate(THROWS):
        progress("refine: propose a throw", done, len(THROWS))
        named = {f"velocity_{a}{suffix}": v for a, v in zip("xyz", velocity, strict=True)}
        named |= {f"omega_{a}{suffix}": v for a, v in zip("xyz", omega, strict=True)}
        found.append((apart(named), velocity, omega))
    progress("refine: propose a throw", len(THROWS), len(THROWS))
    difference, velocity, omega = max(found)
    axes = problem.axes
    return Proposal(
        (best.model.effects[-1], rival.model.effects[-1]),
        axes.vectors_to_world(np.array(velocity)),
        axes.vectors_to_world(np.array(omega)),
        difference,
        apart({}),
    )
