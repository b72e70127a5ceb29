"""What the best models without any effect make of a motion."""

from __future__ import annotations

import numpy as np

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.identify.classical_fit import FamilyFit, fit_family, ranked
from masiv.identify.families import FAMILIES
from masiv.identify.problem import Problem
from masiv.progress import Progress
from masiv.refine.config import RefineConfig
from masiv.refine.model import Model, Simulation, parameters
from masiv.refine.refit import Fitted, column, full_fit, softness, started, summarised

SHORT, HALF = 1 / 3, 1 / 2


def baselines(
    simulation: Simulation,
    few: Problem,
    fewer: Problem,
    first_frames: int,
    config: RefineConfig,
    checkpoint: Checkpoint,
    progress: Progress,
) -> list[Fitted]:
    """Fits of the classical laws that explain the motion best, without effects.

    few: the first experiment's fitted frames alone; fewer: the same with fewer particles. Where more than
    ``config.families`` laws may compete, those best in a short fit to ``fewer`` do. They are fitted to ``few``,
    then to all experiments. Raises MasivError where no law explains the motion.
    """
    motion = simulation.experiments[0].motion
    kinds = [n for n in FAMILIES if not config.laws or n in config.laws]
    if len(kinds) > config.families:
        short: list[FamilyFit] = []
        for kind in kinds:
            try:
                short.append(fit_family(kind, fewer, motion, first_frames, Checkpoint(None), progress, share=SHORT))
            except MasivError as failed:
                progress(f"refine: {kind}", 1, 1, str(failed))
        if not short:
            raise MasivError("refine: no classical law explains the motion; look at its trajectory in the report")
        kinds = [f.kind for f in ranked(short)[: config.families]]
    out = []
    for done, kind in enumerate(kinds):
        found = fit_family(kind, few, motion, first_frames, checkpoint, progress, share=HALF)
        out.append(_joint(simulation, found, config))
        progress("refine: laws without effects", done + 1, len(kinds), f"{kind}: {out[-1].fit_mm:.1f} mm")
    return out


def _joint(simulation: Simulation, found: FamilyFit, config: RefineConfig) -> Fitted:
    """The fit of the first experiment, carried to all."""
    first = simulation.experiments[0].name
    family = FAMILIES[found.kind].scaled(simulation.experiments[0].problem.scene.density)
    law = {p.name for p in family.parameters}
    values = {name if name in law else f"{name}@{first}": value for name, value in found.values.items()}
    model = Model(family, found.contact)
    if len(simulation.experiments) > 1:
        return full_fit(simulation, model, values, budget=config.baseline_rollouts)
    params = started(parameters(model, simulation.experiments), values)
    values = {p.name: p.start for p in params}
    residual = simulation.residual(model, values)
    jacobian = np.stack([column(simulation, model, values, residual, p) for p in params], axis=1)
    return summarised(simulation, model, params, values, jacobian, soft=softness(residual))
