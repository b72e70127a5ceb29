"""Independent parts of the search in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from masiv.inference.model_fit import ModelFit
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Ranking, score
from masiv.workers import Workers, run_task, unwrap

EFFECTS_PER_TASK = 3
"""Effects that one process ranks before it reports."""


def map_tasks(
    workers: Workers, forward_model: ForwardModel, function: Callable, tasks: Iterable[tuple]
) -> Iterator[Any]:
    """``function(forward_model, *task)`` of each task, in order, or ``TaskError``; rollouts are counted."""
    for result, rollouts in workers.map(_counted, tasks, shared=(function, forward_model)):
        forward_model.rollouts += rollouts
        yield result


def _counted(function: Callable, forward_model: ForwardModel, *task: Any) -> tuple[Any, int]:
    before = forward_model.rollouts
    out = run_task(function, (forward_model, *task))
    done, forward_model.rollouts = forward_model.rollouts - before, before
    return out, done


def rank(
    workers: Workers,
    forward_model: ForwardModel,
    base: ModelFit,
    names: Sequence[str],
    *,
    robust_scale: float,
    progress: Callable[[str, int, int], None],
) -> Ranking:
    """``score`` of the effects ``names``, a few in each task; ties in the order of ``names``. Raises MasivError."""
    parts = [list(names[k : k + EFFECTS_PER_TASK]) for k in range(0, len(names), EFFECTS_PER_TASK)]
    candidates, not_ranked = [], {}
    done = 0
    progress(parts[0][0] if parts else "", 0, len(names))
    results = map_tasks(workers, forward_model, _score_part, [(base, robust_scale, part) for part in parts])
    for part, result in zip(parts, results, strict=True):
        ranking: Ranking = unwrap(result)
        candidates += ranking.candidates
        not_ranked |= ranking.not_ranked
        done += len(part)
        progress(part[-1], done, len(names))
    place = {name: k for k, name in enumerate(names)}
    return Ranking(tuple(sorted(candidates, key=lambda c: (-c.explained, place[c.effect]))), not_ranked)


def _score_part(forward_model: ForwardModel, base: ModelFit, robust_scale: float, names: list[str]) -> Ranking:
    return score(forward_model, base, names, robust_scale=robust_scale)
