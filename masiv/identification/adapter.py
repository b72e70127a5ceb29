"""Identification with an adapter: a classical law and a small neural correction of it, trained on its residual."""

from __future__ import annotations

from typing import Any

from masiv.checkpoint import Checkpoint, NestedCheckpoint
from masiv.identification.classical.fit import FamilyFit
from masiv.identification.neural.training import train, whole_trajectory_error
from masiv.identification.recording import FitRecording
from masiv.identification.result import IdentificationResult
from masiv.materials.adapter import AdapterLaw
from masiv.progress import Progress


def fit_adapter(
    base: FamilyFit,
    recording: FitRecording,
    report: dict[str, Any],
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> IdentificationResult:
    """An adapter on the law of ``base``, which stays fixed. report: numbers of the fit of ``base``.

    After a classical fit with pictures the adapter is trained on surfaces and pictures. Raises MasivError.
    """
    objective = recording.objective
    law = AdapterLaw(base.law, rank=objective.config.adapter_rank, seed=seed).float()
    law.base.double()
    if objective.has_surface_finetune:
        objective = objective.with_surface_loss(objective.config.iterations)
    # The classical law was fitted to all frames: training starts with all of them.
    start = FitRecording(objective, base.initial_state, objective.problem.frames)
    nested = NestedCheckpoint(checkpoint, checkpoint.load() or {})
    trained = train([start], law, base.contact, seed=seed, checkpoint=nested, progress=progress)
    report = {**report, "classical_error_mm": 1e3 * base.error_m}
    error = whole_trajectory_error([start], trained, base.contact)
    return IdentificationResult(
        trained.law, trained.initial_states[0], base.contact, error, report, trained.history_rows()
    )
