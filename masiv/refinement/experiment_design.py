"""Which initial state would distinguish two explanations?"""

from __future__ import annotations

from typing import cast

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import ModelFit
from masiv.models.free_body import FreeBodyModel
from masiv.progress import Progress
from masiv.refinement.result import Proposal
from masiv.refinement.rounds import Round, SearchResult
from masiv.refinement.tasks import map_tasks
from masiv.workers import Workers, unwrap

INITIAL_STATES = (
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0)),
    ((-3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 3.0, 0.0), (0.0, 0.0, 0.0)), ((2.0, 2.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.0, -3.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 1.0, 0.0), (0.0, 10.0, 0.0)), ((0.0, 1.0, 0.0), (10.0, 0.0, 0.0)),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 10.0)),
)  # fmt: skip
"""Velocities [m/s] and spins [rad/s] that a person could give a body by hand, simulation frame (y up)."""


def propose(search: SearchResult, progress: Progress, workers: Workers | None = None) -> Proposal | None:
    """The initial state for which the first accepted effect and its closest rival differ most. None if nothing was
    accepted, if the data distinguishes the two, and if the rollouts of all initial states diverge."""
    first = search.rounds[0] if search.rounds else None
    if first is None or first.accepted is None:
        return None
    best = first.accepted.fitted
    rival = _rival(first, best)
    if rival is None:
        return None
    forward_model = cast(FreeBodyModel, search.forward_model)
    axes, suffix = forward_model.setups[0].body.axes, f"@{forward_model.observations[0].name}"
    states = [{}]  # as it was
    for velocity, omega in INITIAL_STATES:
        state = {f"velocity_{a}{suffix}": v for a, v in zip("xyz", velocity, strict=True)}
        states.append(state | {f"omega_{a}{suffix}": v for a, v in zip("xyz", omega, strict=True)})
    found: list[float | str] = []
    tasks = [(best, rival, state) for state in states]
    for done, difference in enumerate(map_tasks(workers or Workers(), forward_model, _difference_mm, tasks)):
        progress("refine: propose an initial state", done + 1, len(states))
        found.append(unwrap(difference))
    present, *others = found
    differences, failures = [], []
    for (velocity, omega), difference in zip(INITIAL_STATES, others, strict=True):
        if isinstance(difference, str):
            world = (axes.vectors_to_world(np.array(v)) for v in (velocity, omega))
            failures.append((*world, difference))
        else:
            differences.append((difference, velocity, omega))
    if not differences:
        return None
    difference, velocity, omega = max(differences)
    return Proposal(
        (best.model.effects[-1], rival.model.effects[-1]),
        axes.vectors_to_world(np.array(velocity)),
        axes.vectors_to_world(np.array(omega)),
        difference,
        None if isinstance(present, str) else present,
        tuple(failures),
    )


def _difference_mm(
    forward_model: FreeBodyModel, best: ModelFit, rival: ModelFit, state: dict[str, float]
) -> float | str:
    """Root mean square distance [mm] of two fits that start as ``state`` says, or why they cannot be simulated."""
    frames = forward_model.setups[0].body.frames
    try:
        a, b = (forward_model.positions(f.model, {**f.values, **state}, 0, frames) for f in (best, rival))
    except NonFiniteError as error:
        return error.detail
    return 1e3 * float((a - b).square().sum(2).mean().sqrt())


def _rival(first: Round, best: ModelFit) -> ModelFit | None:
    """The most probable other effect in the credible set of the round that accepted ``best``; None if there is none."""
    assert first.posterior is not None
    credible = first.posterior.credible_set()
    others = [
        (credible[h.effects], h.marginal.log_evidence, h.fitted)
        for h in first.posterior.hypotheses
        if h.effects in credible and len(h.effects) == len(best.model.effects) and h.effects != set(best.model.effects)
    ]
    return max(others, key=lambda item: item[:2])[2] if others else None
