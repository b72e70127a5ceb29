"""A neural law from one or two starting laws: both are fitted to the end, and the better fit is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from masiv.checkpoint import Checkpoint, NestedCheckpoint
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.starting_law import StartingLaw, choose_starting_laws, rank_starting_laws
from masiv.identification.neural.surface_finetune import finetune_surfaces
from masiv.identification.neural.training import TrainingResult, train, whole_trajectory_error
from masiv.identification.recording import FitRecording
from masiv.identification.result import IdentificationResult
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress, silent
from masiv.workers import TaskError, Workers, run_task, unwrap, workers_for

START_MARGIN = 1.3
"""The second starting law is fitted, too, if its objective is at most this factor of the first one's. Starting laws are
compared with few particles: the nearest one may lead to the worse fit."""


@dataclass(frozen=True, eq=False)
class _FitFromStart:
    """loss: the image loss after a surface finetune, the objective otherwise. report: image errors."""

    start: StartingLaw
    trained: TrainingResult
    loss: float
    report: dict[str, float]


def fit_neural_law(
    recordings: Sequence[FitRecording],
    coarse: Callable[[], Objective],
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> IdentificationResult:
    """The neural law that explains all ``recordings`` best, and the initial state of the first.

    coarse: makes the objective of the first recording with few particles, for the choice of starting laws.
    The error of the result is over all frames of the recordings, those at rest included. Raises MasivError if every fit
    diverges.
    """
    config = recordings[0].objective.config
    saved = checkpoint.load() or {}
    if "starts" in saved:
        starts = [StartingLaw.from_state(state) for state in saved["starts"]]
    else:
        with workers_for(config.processes, config.scheduler, "identify.processes") as workers:
            workers.start()
            chosen = choose_starting_laws(coarse(), recordings[0].initial_state, progress, workers, checkpoint)
            starts = _starts_to_fit(chosen)
    nested = NestedCheckpoint(checkpoint, {"starts": [start.state() for start in starts]})
    if "starts" not in saved:
        nested.save({})
    # New processes: those of the search would keep the states of its rollouts.
    with workers_for(config.processes, config.scheduler, "identify.processes") as workers:
        fits = _fit_in_parallel(recordings, starts, seed, nested, progress, workers)
    succeeded = [
        _fit_from_state(start, fit) for start, fit in zip(starts, fits, strict=True) if not isinstance(fit, TaskError)
    ]
    best = _best(succeeded) if succeeded else unwrap(fits[0])
    report: dict[str, Any] = {
        "start": best.start.material, "start_objective": best.start.objective,
        "geometry_loss": config.geometry_loss, "recordings": len(recordings), **best.report,
    }  # fmt: skip
    trained, contact = best.trained, best.start.contact
    return IdentificationResult(
        trained.law, trained.initial_states[0], contact, whole_trajectory_error(recordings, trained, contact), report,
        trained.history_rows(),
    )  # fmt: skip


def _starts_to_fit(starts: Sequence[StartingLaw]) -> list[StartingLaw]:
    first, *rest = starts
    return [first, *(s for s in rest[:1] if s.objective <= START_MARGIN * first.objective)]


def _fit_in_parallel(
    recordings: Sequence[FitRecording],
    starts: Sequence[StartingLaw],
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
    workers: Workers,
) -> list[dict[str, Any] | TaskError]:
    """The state of the fit from each of ``starts``: the first in this process, the others in ``workers``.

    Each has a checkpoint of its own; another machine has none.
    """

    def second_progress(stage: str, done: int, total: int, note: str = "") -> None:
        progress(f"{stage}, second start", done, total, note)

    progress_of_others = silent if workers.processes > 1 else second_progress
    others = []
    for k, start in enumerate(starts[1:], 2):
        part = checkpoint.part(f"start-{k}") if workers.on_this_machine else Checkpoint(None)
        others.append(workers.submit(_fit_from_start, (recordings, start, seed, part, progress_of_others)))
    first = run_task(_fit_from_start, (recordings, starts[0], seed, checkpoint, progress))
    if others and progress_of_others is silent:
        progress("identify: fit, second start", 0, 1, "goes on in another process")
    return [first, *(result() for result in others)]


def _best(fits: Sequence[_FitFromStart]) -> _FitFromStart:
    """The fit with the least loss, with the margin of ``rank_starting_laws``."""
    fitted = [StartingLaw(f.start.material, f.start.contact, f.start.law, f.loss) for f in fits]
    return fits[fitted.index(rank_starting_laws(fitted)[0])]


def _fit_from_start(
    recordings: Sequence[FitRecording], start: StartingLaw, seed: int, checkpoint: Checkpoint, progress: Progress
) -> dict[str, Any]:
    """The state of the fit from ``start``, the surface finetune included if there is one.

    Fits are compared after the surface finetune, by image loss: after the fit to paths alone the worse one may be the
    nearer.
    """
    saved = checkpoint.load() or {}
    if "trained" in saved:
        trained = TrainingResult.from_state(saved["trained"], NeuralLaw(width=start.law.width))
    else:
        trained = train(recordings, start.law, start.contact, seed=seed, checkpoint=checkpoint, progress=progress)
    loss, report = trained.objective, {}
    if all(r.objective.has_surface_finetune for r in recordings):
        nested = NestedCheckpoint(checkpoint, {"trained": trained.state()})
        if "trained" not in saved:
            nested.save({})
        trained, loss, report = finetune_surfaces(
            recordings, trained, start.contact, start.law, seed=seed, checkpoint=nested, progress=progress
        )
    return {"trained": trained.state(), "loss": loss, "report": report}


def _fit_from_state(start: StartingLaw, state: dict[str, Any]) -> _FitFromStart:
    trained = TrainingResult.from_state(state["trained"], NeuralLaw(width=start.law.width))
    return _FitFromStart(start, trained, state["loss"], state["report"])
