"""Independent parts of the loop, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from masiv.refine.refit import Fitted
from masiv.refine.score import Candidate, score
from masiv.refine.simulated import Simulated
from masiv.workers import Workers, attempt, demanded

NAMES_A_TASK = 3


def side_by_side(workers: Workers, simulation: Simulated, function: Callable, tasks: Iterable[tuple]) -> Iterator[Any]:
    """``function(simulation, *task)`` of each task, in order, or ``Failed``; rollouts are counted."""
    for found, rollouts in workers.map(_counted, [(function, simulation, *task) for task in tasks]):
        simulation.rollouts += rollouts
        yield found


def _counted(function: Callable, simulation: Simulated, *task: Any) -> tuple[Any, int]:
    before = simulation.rollouts
    out = attempt(function, (simulation, *task))
    done, simulation.rollouts = simulation.rollouts - before, before
    return out, done


def ranked(
    workers: Workers,
    simulation: Simulated,
    base: Fitted,
    *,
    soft: float,
    names: Sequence[str],
    progress: Callable[[str, int, int], None],
) -> list[Candidate]:
    """``score`` of the causes ``names``, a few in each task. Raises MasivError."""
    parts = [list(names[k : k + NAMES_A_TASK]) for k in range(0, len(names), NAMES_A_TASK)]
    out: list[Candidate] = []
    done = 0
    progress(parts[0][0] if parts else "", 0, len(names))
    found = side_by_side(workers, simulation, _scored, [(base, soft, part) for part in parts])
    for part, candidates in zip(parts, found, strict=True):
        out += demanded(candidates)
        done += len(part)
        progress(part[-1], done, len(names))
    place = {name: k for k, name in enumerate(names)}
    return sorted(out, key=lambda c: (-c.explained, place[c.effect]))


def _scored(simulation: Simulated, base: Fitted, soft: float, names: list[str]) -> list[Candidate]:
    return score(simulation, base, soft=soft, names=names)
