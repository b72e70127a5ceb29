"""Surface finetune: after the fit to particle paths, a shorter one to surfaces and pictures.

Paths show which part of the body went where, and guide a fit from far away. In a body that flows they drift inside,
where no picture shows them, and a law that is fitted to them learns the drift. Surfaces, silhouettes and colors do not
drift.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence

import torch

from masiv.checkpoint import Checkpoint
from masiv.errors import NonFiniteError
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.training import TrainingResult, train
from masiv.identification.recording import FitRecording
from masiv.materials.neural import NeuralLaw
from masiv.progress import Progress


def finetune_surfaces(
    recordings: Sequence[FitRecording],
    trained: TrainingResult,
    contact: str,
    prior: NeuralLaw,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> tuple[TrainingResult, float, dict[str, float]]:
    """Continue from ``trained``, a neural law, with half as many iterations on surfaces and pictures.

    Returns the new result if its image loss over all frames is clearly lower (``is_clearly_lower``), else ``trained``;
    its image loss; and the image errors of both, those of a result that diverges left out. Raises NonFiniteError if
    ``trained`` diverges after the frames of its fit.
    """
    path_iterations = recordings[0].objective.config.iterations
    objectives = [r.objective.with_surface_loss(path_iterations // 2) for r in recordings]
    surfaces = [
        FitRecording(objective, state, objective.problem.frames)
        for objective, state in zip(objectives, trained.initial_states, strict=True)
    ]
    finetuned = train(
        surfaces, trained.law, contact, seed=seed, checkpoint=checkpoint, progress=progress, prior=prior,
        label="identify: fit surfaces",
    )  # fmt: skip
    finetuned.history = [*trained.history, *((i + path_iterations, *row) for i, *row in finetuned.history)]
    errors = {"paths": _image_errors(objectives, trained, contact)}
    with contextlib.suppress(NonFiniteError):
        errors["surfaces"] = _image_errors(objectives, finetuned, contact)
    report = {f"silhouette_error_of_{name}": float(silhouette.mean()) for name, (silhouette, _) in errors.items()}
    if objectives[0].images.colors is not None:
        report |= {f"color_error_of_{name}": float(color.mean()) for name, (_, color) in errors.items()}
    before, *after = (objectives[0].image_loss(e) for e in errors.values())
    if after and is_clearly_lower(after[0], before):
        return finetuned, float(after[0].mean()), report
    return trained, float(before.mean()), report


def is_clearly_lower(after: torch.Tensor, before: torch.Tensor) -> bool:
    """Whether the mean of losses (T,) ``after`` is lower than that of ``before`` by a standard error of the difference.

    The losses are paired: of the same frames. The one-standard-error rule (Breiman et al., Classification and
    Regression Trees, 1984, section 3.4.3): a difference within its standard error is no reason to leave the first one.
    """
    difference = (after - before).double()
    count = len(difference)
    standard_error = float(difference.std()) / math.sqrt(count) if count > 1 else 0.0
    return float(difference.mean()) < -standard_error


def _image_errors(
    objectives: Sequence[Objective], trained: TrainingResult, contact: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Errors (T,) of silhouettes and of colors, of the frames of all recordings."""
    errors = [
        objective.whole_image_errors(objective.whole_rollout(trained.law, state, contact))
        for objective, state in zip(objectives, trained.initial_states, strict=True)
    ]
    silhouettes, colors = zip(*errors, strict=True)
    return torch.cat(silhouettes), torch.cat(colors)
