"""A neural law: its starts, a fit from the nearest, beside it one from its rival, and the polish of the better."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from masiv.checkpoint import Checkpoint
from masiv.identify.fit import Fit, fit, fit_from, fit_state
from masiv.identify.found import Found, history_rows
from masiv.identify.polish import polish, wanted
from masiv.identify.problem import Motion, Problem
from masiv.identify.start import Start, best_first, choose_start
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress, silent
from masiv.workers import Failed, Workers, processes_wanted

RIVAL = 1.3
"""The second start is fitted, too, where its error is at most this factor of the first's. Starts are simulated with few
particles: what is nearer there may lead to the worse fit (sand began as a viscous fluid)."""


def learn(
    problem: Problem,
    few: Callable[[], Problem],
    motion: Motion,
    first_frames: int,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Found:
    """The neural law and the throw that explain ``problem`` best. few: the same with few particles, for the search of a
    start. first_frames: how many frames the fit begins with. Raises MasivError."""
    saved = checkpoint.load() or {}
    with Workers(processes_wanted(problem.config.processes), "identify.processes") as workers:
        if "starts" in saved:
            starts = [_start_from(state) for state in saved["starts"]]
        else:
            workers.begin()
            saved, starts = {}, _worth_fitting(choose_start(few(), motion, progress, workers))
        fixed: dict[str, Any] = {"starts": [_start_state(start) for start in starts]}
        keeper = _With(checkpoint, fixed)
        if "fitted" in saved:
            start = starts[saved["chosen"]]
            fitted = fit_from(saved["fitted"], NeuralLaw(width=start.law.width))
        else:
            keeper.save(saved)
            heard = silent if workers.processes > 1 else (lambda _, *said: progress("identify: fit a rival", *said))
            rest = [workers.beside(_fitted, (problem, s, motion, first_frames, seed, heard)) for s in starts[1:]]
            reached = [(starts[0], _fit(problem, starts[0], motion, first_frames, seed, keeper, progress))]
            for rival, waited in zip(starts[1:], rest, strict=True):
                state = waited()
                if not isinstance(state, Failed):  # it diverges, perhaps
                    reached.append((rival, fit_from(state, NeuralLaw(width=rival.law.width))))
            start, fitted = _better(reached)
    report: dict[str, Any] = {
        "start": start.material, "start_objective": start.error, "geometry_loss": problem.config.geometry_loss
    }  # fmt: skip
    if wanted(problem):
        chosen = {"chosen": starts.index(start), "fitted": fit_state(fitted)}
        keeper = _With(checkpoint, fixed | chosen)
        if "fitted" not in saved:
            keeper.save({})
        fitted, seen = polish(
            problem, fitted, start.contact, start.law, seed=seed, checkpoint=keeper, progress=progress
        )  # fmt: skip
        report |= seen
    return Found(fitted.law, fitted.motion, start.contact, fitted.error_m, report, history_rows(fitted))


def _worth_fitting(starts: list[Start]) -> list[Start]:
    first, *rest = starts
    return [first, *(s for s in rest[:1] if s.error <= RIVAL * first.error)]


def _better(reached: list[tuple[Start, Fit]]) -> tuple[Start, Fit]:
    """By the objective, with the same advantage to the elastic one as among starts."""
    ends = [Start(start.material, start.contact, start.law, fitted.objective) for start, fitted in reached]
    return reached[ends.index(best_first(ends)[0])]


def _fit(
    problem: Problem, start: Start, motion: Motion, first: int, seed: int, checkpoint: Checkpoint, progress: Progress
) -> Fit:
    return fit(problem, start.law, motion, start.contact, first, seed=seed, checkpoint=checkpoint, progress=progress)


def _fitted(problem: Problem, start: Start, motion: Motion, first: int, seed: int, progress: Progress) -> dict:
    """The state of a fit, as a task of another process."""
    return fit_state(_fit(problem, start, motion, first, seed, Checkpoint(None), progress))


class _With(Checkpoint):
    """A checkpoint whose every state also holds ``fixed``."""

    def __init__(self, checkpoint: Checkpoint, fixed: dict) -> None:
        super().__init__(checkpoint.path, checkpoint.every_s)
        self.fixed = fixed

    def save(self, state: dict) -> None:
        super().save({**state, **self.fixed})


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
