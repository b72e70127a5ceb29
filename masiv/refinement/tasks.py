"""Independent parts of the search in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from masiv.inference.model_fit import ModelFit
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Ranking, score
from masiv.workers import Workers, run_task, unwrap


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
    """``score`` of the effects ``names``, each a task; ties in the order of ``names``. Raises MasivError."""
    candidates, not_ranked = [], {}
    progress(names[0] if names else "", 0, len(names))
    results = map_tasks(workers, forward_model, _score_one, [(base, robust_scale, name) for name in names])
    for done, (name, result) in enumerate(zip(names, results, strict=True)):
        ranking: Ranking = unwrap(result)
        candidates += ranking.candidates
        not_ranked |= ranking.not_ranked
        progress(name, done + 1, len(names))
    place = {name: k for k, name in enumerate(names)}
    return Ranking(tuple(sorted(candidates, key=lambda c: (-c.explained, place[c.effect]))), not_ranked)


def _score_one(forward_model: ForwardModel, base: ModelFit, robust_scale: float, name: str) -> Ranking:
    return score(forward_model, base, [name], robust_scale=robust_scale)
