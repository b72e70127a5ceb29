"""Fits of classical laws without any effect, from which a search starts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identification.classical.fit import FamilyFit, fit_family
from masiv.identification.classical.model_selection import rank_by_bic
from masiv.identification.losses.objective import Objective
from masiv.inference.least_squares import linearize, with_start_values
from masiv.inference.model_fit import ModelFit, evaluate_fit, gauss_newton_fit, residual_of
from masiv.inference.robust import robust_scale_of
from masiv.models.base import Model
from masiv.models.families import CONTINUUM_FAMILIES, FAMILIES
from masiv.models.free_body import FreeBodyModel
from masiv.models.initial_state import InitialState
from masiv.progress import Progress, silent
from masiv.refinement.config import RefineConfig
from masiv.refinement.search import fits_of
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError, Workers

SHORT_BUDGET, BUDGET = 1 / 3, 1 / 2
"""Parts of the rollouts that identify allows a stage: of the short fits that choose the laws, and of the others."""
ALL_FRAMES_STAGE = 2
"""``FamilyFit.stage`` of a fit to all frames."""


@dataclass(frozen=True)
class BaselineProblem:
    """The fitted frames of the first observation. coarse: on the particles of the search; coarser: on fewer;
    first_frames: frames of the first fit, free flight and first contact."""

    coarse: Objective
    coarser: Objective
    first_frames: int


def baselines(
    forward_model: FreeBodyModel,
    problem: BaselineProblem,
    config: RefineConfig,
    checkpoint: Checkpoint,
    progress: Progress,
    workers: Workers,
) -> list[ModelFit]:
    """Fits of the classical laws that explain the motion best, without effects.

    If more than ``config.families`` laws may compete, those best in a short fit on ``problem.coarser`` do. They are
    fitted on ``problem.coarse``, then to all observations. Raises MasivError if no law explains the motion.
    """
    kinds = [n for n in FAMILIES if n in (config.laws or CONTINUUM_FAMILIES)]
    progress(LABEL, 0, len(kinds), ", ".join(kinds))
    if len(kinds) > config.families:
        kinds = _shortlist(forward_model, problem, kinds, config, progress, workers)
    fits = _fitted(forward_model, problem, kinds, checkpoint, progress, workers)
    starts = [_start(forward_model, fit) for fit in fits]
    results = map_tasks(workers, forward_model, differentiated, [(*s, config.baseline_rollouts) for s in starts])
    return fits_of(results)


LABEL = "refine: laws without effects"


def _shortlist(
    forward_model: FreeBodyModel, problem: BaselineProblem, kinds: Sequence[str], config: RefineConfig,
    progress: Progress, workers: Workers,
) -> list[str]:  # fmt: skip
    """The laws that are best in a short fit."""
    motion = forward_model.setups[0].start
    tasks = [(kind, problem.coarser, motion, problem.first_frames, SHORT_BUDGET) for kind in kinds]
    short = list(_known(kinds, workers.map(_fit_family, tasks), progress))
    return [f.kind for f in rank_by_bic(_some(short))[: config.families]]


def _fitted(
    forward_model: FreeBodyModel, problem: BaselineProblem, kinds: Sequence[str], checkpoint: Checkpoint,
    progress: Progress, workers: Workers,
) -> list[FamilyFit]:  # fmt: skip
    """Fits of the laws ``kinds``, those in the checkpoint taken from there."""
    motion = forward_model.setups[0].start
    states = (checkpoint.load() or {}).items()
    saved = {kind: FamilyFit(**state) for kind, state in states if state["stage"] >= ALL_FRAMES_STAGE}
    missing = [kind for kind in kinds if kind not in saved]
    tasks = [(kind, problem.coarse, motion, problem.first_frames, BUDGET) for kind in missing]
    for fit in _known(missing, workers.map(_fit_family, tasks), progress):
        saved[fit.kind] = fit
        checkpoint.save({kind: fit.state() for kind, fit in saved.items()})
    return _some([saved[kind] for kind in kinds if kind in saved])


def _fit_family(kind: str, objective: Objective, motion: InitialState, first_frames: int, budget: float) -> FamilyFit:
    return fit_family(kind, objective, motion, first_frames, Checkpoint(None), silent, budget_factor=budget)


def _known(kinds: Sequence[str], results: Iterable[FamilyFit | TaskError], progress: Progress) -> Iterator[FamilyFit]:
    """Those that explain the motion."""
    for done, (kind, fit) in enumerate(zip(kinds, results, strict=True)):
        note = fit.reason if isinstance(fit, TaskError) else f"{1e3 * fit.error_m:.1f} mm"
        progress(LABEL, done + 1, len(kinds), f"{kind}: {note}")
        if not isinstance(fit, TaskError):
            yield fit


def _some(fits: list[FamilyFit]) -> list[FamilyFit]:
    """``fits``, if there are any. Raises MasivError."""
    if not fits:
        raise MasivError("refine: no classical law explains the motion; look at its trajectory in the report")
    return fits


def _start(forward_model: FreeBodyModel, fit: FamilyFit) -> tuple[Model, dict[str, float]]:
    """The model that fits the first observation, and its values, to start from in all."""
    first = forward_model.observations[0]
    family = FAMILIES[fit.kind].scaled(forward_model.setups[0].body.scene.density)
    law = {p.name for p in family.parameters}
    values = {name if name in law else f"{name}@{first.name}": value for name, value in fit.values.items()}
    model = Model(family, fit.contact)
    forward_model.hold_substeps(model, values)
    return model, values


def differentiated(forward_model: FreeBodyModel, model: Model, values: dict[str, float], budget: int) -> ModelFit:
    """``values`` with derivatives; fitted to all observations in ``budget`` rollouts if there are several. Raises
    NonFiniteError."""
    if len(forward_model.observations) > 1:
        return gauss_newton_fit(forward_model, model, values, budget=budget)
    parameters = with_start_values(forward_model.parameters(model), values)
    here = linearize(residual_of(forward_model, model), parameters, {p.name: p.start for p in parameters})
    scale = robust_scale_of(here.residual)
    return evaluate_fit(forward_model, model, parameters, here.values, here.jacobian, robust_scale=scale)
