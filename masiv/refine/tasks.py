"""Independent parts of the loop, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from masiv.inference.model_fit import ModelFit
from masiv.models.base import ForwardModel
from masiv.refine.candidates import Candidate, score
from masiv.workers import Workers, run_task, unwrap

NAMES_A_TASK = 3


def map_tasks(workers: Workers, simulation: ForwardModel, function: Callable, tasks: Iterable[tuple]) -> Iterator[Any]:
    """``function(simulation, *task)`` of each task, in order, or ``TaskError``; rollouts are counted."""
    for found, rollouts in workers.map(_counted, tasks, shared=(function, simulation)):
        simulation.rollouts += rollouts
        yield found


def _counted(function: Callable, simulation: ForwardModel, *task: Any) -> tuple[Any, int]:
    before = simulation.rollouts
    out = run_task(function, (simulation, *task))
    done, simulation.rollouts = simulation.rollouts - before, before
    return out, done


def ranked(
    workers: Workers,
    simulation: ForwardModel,
    base: ModelFit,
    *,
    robust_scale: float,
    names: Sequence[str],
    progress: Callable[[str, int, int], None],
) -> list[Candidate]:
    """``score`` of the causes ``names``, a few in each task. Raises MasivError."""
    parts = [list(names[k : k + NAMES_A_TASK]) for k in range(0, len(names), NAMES_A_TASK)]
    out: list[Candidate] = []
    done = 0
    progress(parts[0][0] if parts else "", 0, len(names))
    found = map_tasks(workers, simulation, _scored, [(base, robust_scale, part) for part in parts])
    for part, candidates in zip(parts, found, strict=True):
        out += unwrap(candidates)
        done += len(part)
        progress(part[-1], done, len(names))
    place = {name: k for k, name in enumerate(names)}
    return sorted(out, key=lambda c: (-c.explained, place[c.effect]))


def _scored(simulation: ForwardModel, base: ModelFit, robust_scale: float, names: list[str]) -> list[Candidate]:
    return score(simulation, base, robust_scale=robust_scale, names=names)
