"""A neural law: its starts, a fit from the nearest, beside it one from its rival, and the choice between the two."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from masiv.checkpoint import Checkpoint
from masiv.identify.fit import Fit, fit, fit_from, fit_state
from masiv.identify.found import Found, history_rows
from masiv.identify.polish import polish, wanted
from masiv.identify.problem import Problem
from masiv.identify.start import Start, best_first, choose_start
from masiv.identify.throw import Throw
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress, silent
from masiv.workers import TaskError, Workers, processes_wanted, run_task, unwrap

RIVAL = 1.3
"""The second start is fitted, too, where its error is at most this factor of the first's. Starts are simulated with few
particles: what is nearer there may lead to the worse fit (sand began as a viscous fluid)."""


@dataclass(frozen=True, eq=False)
class Reached:
    """A start and the fit from it; error: what it is compared with others by."""

    start: Start
    fitted: Fit
    error: float
    report: dict[str, float]


def learn(
    throws: Sequence[Throw], coarse: Callable[[], Problem], seed: int, checkpoint: Checkpoint, progress: Progress
) -> Found:
    """The neural law that explains all ``throws`` best, and the motion of the first. few: the first with few particles,
    for the search of a start. Raises MasivError."""
    config = throws[0].problem.config
    saved = checkpoint.load() or {}
    with Workers(processes_wanted(config.processes), "identify.processes") as workers:
        if "starts" in saved:
            starts = [_start_from(state) for state in saved["starts"]]
        else:
            workers.begin()
            starts = _worth_fitting(choose_start(coarse(), throws[0].motion, progress, workers))
        keeper = _With(checkpoint, {"starts": [_start_state(start) for start in starts]})
        if "starts" not in saved:
            keeper.save({})
        heard = silent if workers.processes > 1 else (lambda what, *said: progress(f"{what}, a rival", *said))
        rest = [workers.submit(_reach_apart, (throws, s, seed, heard)) for s in starts[1:]]
        first = run_task(_reach, (throws, starts[0], seed, keeper, progress))
        ends = [(starts[0], first), *((start, waited()) for start, waited in zip(starts[1:], rest, strict=True))]
    reached = [
        _reached_from(start, end) for start, end in ends if not isinstance(end, TaskError)
    ]  # it diverges, perhaps
    kept = _best(reached) if reached else unwrap(first)
    report: dict[str, Any] = {
        "start": kept.start.material, "start_objective": kept.start.error,
        "geometry_loss": config.geometry_loss, "throws": len(throws), **kept.report,
    }  # fmt: skip
    fitted = kept.fitted
    return Found(fitted.law, fitted.motions[0], kept.start.contact, fitted.error_m, report, history_rows(fitted))


def _worth_fitting(starts: list[Start]) -> list[Start]:
    first, *rest = starts
    return [first, *(s for s in rest[:1] if s.error <= RIVAL * first.error)]


def _best(reached: list[Reached]) -> Reached:
    """The nearest, with the same advantage to the elastic one as among starts."""
    ends = [Start(r.start.material, r.start.contact, r.start.law, r.error) for r in reached]
    return reached[ends.index(best_first(ends)[0])]


def _reach(
    throws: Sequence[Throw], start: Start, seed: int, checkpoint: Checkpoint, progress: Progress
) -> dict[str, Any]:
    """The state of a fit from ``start`` after everything that is done to one.

    Fits are compared by the pictures where those have the last word: after paths alone the worse one may be nearer to
    them (a letter that flows is a plasticine then, and honey in the end)."""
    saved = checkpoint.load() or {}
    if "fitted" in saved:
        fitted = fit_from(saved["fitted"], NeuralLaw(width=start.law.width))
    else:
        fitted = fit(throws, start.law, start.contact, seed=seed, checkpoint=checkpoint, progress=progress)
    error, seen = fitted.objective, {}
    if all(wanted(throw.problem) for throw in throws):
        keeper = _With(checkpoint, {"fitted": fit_state(fitted)})
        if "fitted" not in saved:
            keeper.save({})
        fitted, error, seen = polish(
            throws, fitted, start.contact, start.law, seed=seed, checkpoint=keeper, progress=progress
        )  # fmt: skip
    return {"fitted": fit_state(fitted), "error": error, "report": seen}


def _reach_apart(throws: Sequence[Throw], start: Start, seed: int, progress: Progress) -> dict[str, Any]:
    """``_reach`` as a task of another process."""
    return _reach(throws, start, seed, Checkpoint(None), progress)


def _reached_from(start: Start, state: dict[str, Any]) -> Reached:
    fitted = fit_from(state["fitted"], NeuralLaw(width=start.law.width))
    return Reached(start, fitted, state["error"], state["report"])


class _With(Checkpoint):
    """``checkpoint``, whose every state also holds ``fixed``."""

    def __init__(self, checkpoint: Checkpoint, fixed: dict) -> None:
        super().__init__(checkpoint.path, checkpoint.every_s)
        self._within = checkpoint
        self._fixed = fixed

    def save(self, state: dict) -> None:
        self._within.save({**state, **self._fixed})
        self._last = time.monotonic()


def _start_state(start: Start) -> dict:
    return {
        "material": start.material,
        "contact": start.contact,
        "error": start.error,
        "width": start.law.width,
        "law": start.law.state_dict(),
    }


def _start_from(state: dict) -> Start:
    law = NeuralLaw(width=state["width"])
    law.load_state_dict(state["law"])
    return Start(state["material"], state["contact"], law, state["error"])
