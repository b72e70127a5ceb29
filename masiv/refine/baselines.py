"""What the best models without any effect make of a motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify.classical_fit import FamilyFit, fit_family, ranked
from masiv.inference.model_fit import (
    ModelFit,
    column,
    evaluate_fit,
    gauss_newton_fit,
    robust_scale_of,
    with_start_values,
)
from masiv.models.families import FAMILIES
from masiv.models.free_body import Model, Simulation, parameters
from masiv.models.initial_state import InitialState
from masiv.models.problem import Problem
from masiv.progress import Progress, silent
from masiv.refine.config import RefineConfig
from masiv.refine.tasks import map_tasks
from masiv.workers import TaskError, Workers, unwrap

SHORT, HALF = 1 / 3, 1 / 2
DONE = 2
"""``FamilyFit.stage`` of a fit to all frames."""


def baselines(
    simulation: Simulation,
    coarse: Problem,
    coarser: Problem,
    first_frames: int,
    config: RefineConfig,
    checkpoint: Checkpoint,
    progress: Progress,
    workers: Workers | None = None,
) -> list[ModelFit]:
    """Fits of the classical laws that explain the motion best, without effects.

    few: the first experiment's fitted frames alone; fewer: the same with fewer particles. Where more than
    ``config.families`` laws may compete, those best in a short fit to ``coarser`` do. They are fitted to ``coarse``,
    then to all experiments. Raises MasivError where no law explains the motion.
    """
    workers = workers or Workers()
    motion = simulation.observations[0].motion
    kinds = [n for n in FAMILIES if not config.laws or n in config.laws]
    progress("refine: laws without effects", 0, len(kinds), ", ".join(kinds))
    if len(kinds) > config.families:
        found = workers.map(_fitted, [(kind, coarser, motion, first_frames, SHORT) for kind in kinds])
        short = _some(list(_known(kinds, found, progress)))
        kinds = [f.kind for f in ranked(short)[: config.families]]
    saved = {kind: FamilyFit(**state) for kind, state in (checkpoint.load() or {}).items() if state["stage"] >= DONE}
    missing = [kind for kind in kinds if kind not in saved]
    found = workers.map(_fitted, [(kind, coarse, motion, first_frames, HALF) for kind in missing])
    for fit in _known(missing, found, progress):
        saved[fit.kind] = fit
        checkpoint.save({kind: fit.state() for kind, fit in saved.items()})
    models = [_carried(simulation, saved[kind]) for kind in _some([kind for kind in kinds if kind in saved])]
    fits = map_tasks(workers, simulation, derived, [(*m, config.baseline_rollouts) for m in models])
    return [unwrap(fitted) for fitted in fits]


def _fitted(kind: str, problem: Problem, motion: InitialState, first_frames: int, share: float) -> FamilyFit:
    return fit_family(kind, problem, motion, first_frames, Checkpoint(None), silent, share=share)


def _known(kinds: Sequence[str], found: Iterable[FamilyFit | TaskError], progress: Progress) -> Iterator[FamilyFit]:
    """Those that explain the motion."""
    for done, (kind, fit) in enumerate(zip(kinds, found, strict=True)):
        note = fit.reason if isinstance(fit, TaskError) else f"{1e3 * fit.error_m:.1f} mm"
        progress("refine: laws without effects", done + 1, len(kinds), f"{kind}: {note}")
        if not isinstance(fit, TaskError):
            yield fit


def _some(found: list) -> list:
    """``found``, if there is any. Raises MasivError."""
    if not found:
        raise MasivError("refine: no classical law explains the motion; look at its trajectory in the report")
    return found


def _carried(simulation: Simulation, found: FamilyFit) -> tuple[Model, dict[str, float]]:
    """The model that fits the first experiment, and its values, to begin with in all."""
    first = simulation.observations[0].name
    family = FAMILIES[found.kind].scaled(simulation.observations[0].problem.scene.density)
    law = {p.name for p in family.parameters}
    values = {name if name in law else f"{name}@{first}": value for name, value in found.values.items()}
    model = Model(family, found.contact)
    simulation.settle(model, values)
    return model, values


def derived(simulation: Simulation, model: Model, values: dict[str, float], rollouts: int) -> ModelFit:
    """``values`` with derivatives; fitted to all experiments where there are several."""
    if len(simulation.observations) > 1:
        return gauss_newton_fit(simulation, model, values, budget=rollouts)
    params = with_start_values(parameters(model, simulation.observations), values)
    values = {p.name: p.start for p in params}
    residual = simulation.residual(model, values)
    jacobian = np.stack([column(simulation, model, values, residual, p) for p in params], axis=1)
    return evaluate_fit(simulation, model, params, values, jacobian, robust_scale=robust_scale_of(residual))
