"""Fits of all law families: each in short, the best ones in full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identification.classical.fit import FamilyFit, fit_family, fit_further, save_fit
from masiv.identification.classical.model_selection import image_losses, rank_by_bic, rank_by_image_loss
from masiv.identification.losses.objective import Objective
from masiv.models.families import CONTINUUM_FAMILIES
from masiv.models.initial_state import InitialState
from masiv.progress import Progress, silent
from masiv.workers import TaskError, Workers

SHORT_FIT = 1 / 3
"""Rollouts of a short fit over those of a full one."""
FINALISTS_BY_PATHS = 2


@dataclass
class FamilyFits:
    """Fits by family, and why the others failed."""

    fits: dict[str, FamilyFit] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    def collect(
        self,
        kinds: Sequence[str],
        function: Callable[..., FamilyFit],
        tasks: Sequence[tuple],
        label: str,
        checkpoint: Checkpoint,
        progress: Progress,
        workers: Workers,
    ) -> None:
        """Run ``function`` on a task of each of ``kinds`` and save each fit."""
        progress(label, 0, len(kinds), ", ".join(kinds))
        for done, (kind, fit) in enumerate(zip(kinds, workers.map(function, tasks), strict=True)):
            if isinstance(fit, TaskError):
                self.failures[kind] = note = fit.reason
            else:
                self.fits[kind] = fit
                save_fit(checkpoint, fit)
                note = f"{1e3 * fit.error_m:.1f} mm"
            progress(label, done + 1, len(kinds), f"{kind}: {note}")


def fit_shortlist(
    coarse: Objective,
    initial_state: InitialState,
    first_frames: int,
    with_images: bool,
    checkpoint: Checkpoint,
    progress: Progress,
    workers: Workers,
) -> FamilyFits:
    """Short fits of every family; then full fits of the finalists.

    Finalists are the best ``FINALISTS_BY_PATHS`` by information criterion, and the best by image loss, which says
    little of a fit that is far from its end. Raises MasivError if no family explains the motion.
    """
    saved = checkpoint.load() or {}
    found = FamilyFits({kind: FamilyFit(**saved[kind]) for kind in CONTINUUM_FAMILIES if kind in saved})
    task_progress = progress if workers.processes == 1 else silent
    missing = [kind for kind in CONTINUUM_FAMILIES if kind not in found.fits]
    tasks = [(kind, coarse, initial_state, first_frames, with_images, task_progress) for kind in missing]
    found.collect(missing, _short_fit, tasks, "identify: classical laws, in short", checkpoint, progress, workers)
    if not found.fits:
        reason = next(iter(found.failures.values()))
        raise MasivError(f"identify: no classical law explains the motion ({reason})")
    finalists = saved.get("finalists")  # saved, since a fit that was continued is no short one any more
    if finalists is None:
        finalists = _finalists(coarse, list(found.fits.values()))
        checkpoint.save({**(checkpoint.load() or {}), "finalists": finalists})
    tasks = [(found.fits[kind], coarse, with_images, task_progress) for kind in finalists]
    found.collect(finalists, _full_fit, tasks, "identify: classical laws, the best", checkpoint, progress, workers)
    return found


def _finalists(coarse: Objective, fits: Sequence[FamilyFit]) -> list[str]:
    best = [*rank_by_bic(fits)[:FINALISTS_BY_PATHS], rank_by_image_loss(fits, image_losses(coarse, fits))[0]]
    return list(dict.fromkeys(fit.kind for fit in best))


def _short_fit(
    kind: str,
    coarse: Objective,
    initial_state: InitialState,
    first_frames: int,
    with_images: bool,
    progress: Progress,
) -> FamilyFit:
    """A task: must be picklable."""
    return fit_family(
        kind, coarse, initial_state, first_frames, Checkpoint(None), progress,
        budget_factor=SHORT_FIT, with_images=with_images,
    )  # fmt: skip


def _full_fit(fit: FamilyFit, coarse: Objective, with_images: bool, progress: Progress) -> FamilyFit:
    """A task: must be picklable."""
    return fit_further(fit, coarse, progress, with_images=with_images)
