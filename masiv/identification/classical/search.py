"""Coarse search over the scales of a law family and the contact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from masiv.errors import MasivError, NonFiniteError
from masiv.identification.classical.residuals import PathResidual
from masiv.identification.losses.geometry import mean_distance
from masiv.identification.losses.objective import Objective
from masiv.models.families import Family
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.progress import Progress

CANDIDATES_WITH_ALL_CONTACTS = 3
"""Number of the best candidates that are tried with every contact."""


@dataclass(frozen=True, order=True)
class _Candidate:
    """A start of a family's fit. cost: what candidates are compared by; error_m: mean distance to the paths [m]."""

    cost: float
    index: int
    contact: str
    error_m: float


@dataclass(frozen=True)
class FamilySearch:
    """The best start, and the number of rollouts that it took to find it."""

    contact: str
    values: dict[str, float]
    error_m: float
    rollouts: int


def search_family(
    objective: Objective, family: Family, initial_state: InitialState, progress: Progress, *, with_images: bool
) -> FamilySearch:
    """The best of ``Family.candidates``.

    Each is tried with the contact that the configuration names; if it names none, the best ones with each. They are
    compared by the mean distance to the paths; with images by the objective, as the starting laws of a neural fit are.
    Raises MasivError if all rollouts diverge.
    """
    problem = objective.problem
    contacts = ["sticky", "release"] if objective.config.contact == "auto" else [objective.config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    start = {p.name: p.start for p in initial_state_parameters(initial_state, objective.ground_range)}
    starts = [{**candidate, **start} for candidate in family.candidates()]
    total = len(starts) + (len(contacts) - 1) * min(CANDIDATES_WITH_ALL_CONTACTS, len(starts))
    tried: list[_Candidate] = []

    def attempt(index: int, contact: str) -> None:
        cost, error_m = _rollout_cost(objective, family, contact, starts[index], with_images)
        tried.append(_Candidate(cost, index, contact, error_m))
        note = "diverges" if math.isinf(cost) else f"{1e3 * error_m:.0f} mm"
        progress(f"identify: {family.kind} search", len(tried), total, note)

    for index in range(len(starts)):
        attempt(index, contacts[0])
    for candidate in sorted(tried)[:CANDIDATES_WITH_ALL_CONTACTS]:
        for contact in contacts[1:]:
            attempt(candidate.index, contact)
    best = min(tried)
    if math.isinf(best.cost):
        raise MasivError(
            f"identify: every starting {family.kind} law diverges; check the scene's ground, gravity and units"
        )
    return FamilySearch(best.contact, starts[best.index], best.error_m, len(tried))


def _rollout_cost(
    objective: Objective, family: Family, contact: str, values: dict[str, float], with_images: bool
) -> tuple[float, float]:
    """What a start is compared by, and its mean distance to the paths [m]; both infinite if it diverges."""
    problem = objective.problem
    try:
        residual = PathResidual(problem, family, contact, problem.frames).field(values)
        error_m = mean_distance(residual)
        if not with_images:
            return error_m, error_m
        positions = torch.from_numpy(residual).float() + problem.targets[: len(residual)]
        return objective.evaluate(positions), error_m
    except NonFiniteError:
        return math.inf, math.inf
