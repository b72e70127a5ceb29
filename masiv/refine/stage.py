"""The refine stage: residual -> ranked effects -> joint refit -> confirmed on held-out frames -> twin with effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.effects.catalogue import effect_named
from masiv.identify.config import RENAMED_STARTS, IdentifyConfig
from masiv.inference.model_fit import ModelFit
from masiv.models.free_body import Simulation
from masiv.models.prepare import video_observation
from masiv.mpm.config import SimulatorConfig
from masiv.observations.motion import Observed, first_frames
from masiv.progress import Progress, silent
from masiv.refine.baselines import baselines
from masiv.refine.config import RefineConfig
from masiv.refine.experiment_design import Proposal, propose
from masiv.refine.search import SearchResult, search_effects
from masiv.scene.scene import Scene
from masiv.simulation.fitted_twin import fitted_twin
from masiv.twin import Twin
from masiv.workers import Workers, process_count

COMPETITORS = {
    "jelly": ("neo_hookean", "von_mises"),
    "plasticine": ("von_mises", "neo_hookean", "non_newtonian"),
    "water": ("newtonian", "non_newtonian"),
    # A Maxwell fluid that relaxes slower than the motion lasts is a solid.
    "maxwell_fluid": ("newtonian", "non_newtonian", "von_mises", "neo_hookean"),
    "sand": ("drucker_prager", "von_mises"),
}
"""Classical laws that are worth a try, by the law whose rollout was nearest to the motion in identify."""


@dataclass(frozen=True)
class Throw:
    """One run. whole: the motion of all frames, of which the first ``fitted`` may be fitted; ``motion`` is of those."""

    name: str
    scene: Scene
    motion: Observed
    whole: Observed
    fitted: int


@dataclass(frozen=True)
class Refined:
    """What was found. fields: residuals before and after, simulated less observed, (K, N, 3) [m, simulation frame] of
    each throw over all frames, at ``samples_per_frame`` instants a frame."""

    result: SearchResult
    simulation: Simulation
    before: list[np.ndarray]
    after: list[np.ndarray]
    proposal: Proposal | None


def split_frames(frame_count: int, fit_frames: int) -> int:
    """How many frames refine fits: those that identify did, or all but the last quarter where it was given all."""
    return fit_frames if fit_frames < frame_count else frame_count - max(1, frame_count // 4)


def refine(
    throws: list[Throw],
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
    *,
    start: str | None = None,
    dry_run: bool = False,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Refined:
    """Look for what the model lacks. throws: of one body, the first to be refined. start: the twin's pretrained law,
    which chooses the competing classical laws unless ``config.laws`` does. dry_run: rank the effects, fit none.

    Raises InputError for an unknown effect in ``config.effects``, MasivError where no law explains the motion.
    """
    for name in config.effects:
        effect_named(name)
    with runtime.torch_threads(1):
        start = RENAMED_STARTS.get(start or "", start)
        if not config.laws and start in COMPETITORS:
            config = config.model_copy(update={"laws": list(COMPETITORS[start])})
        made = [
            video_observation(t.name, t.scene, first_frames(t.motion, t.fitted), t.whole, identify, simulator, config)
            for t in throws
        ]
        simulation = Simulation([observation for observation, *_ in made])
        _, coarse, coarser, initial_motion = made[0]
        with Workers(process_count(config.processes)) as workers:
            fits = baselines(
                simulation,
                coarse,
                coarser,
                min(initial_motion.last_frame + 2, coarse.frames),
                config,
                checkpoint or Checkpoint(None),
                progress,
                workers,
            )
            if dry_run:
                config = config.model_copy(update={"shortlist": 0, "above_noise": 0.0})
            result = search_effects(simulation, fits, config, progress, workers)
        proposal = None if dry_run else propose(simulation, result, progress)
        return Refined(result, simulation, result.before.fields, (result.gap or result.after).fields, proposal)


def refined_twin(twin: Twin, fitted: ModelFit, simulation: Simulation) -> Twin:
    """``twin`` with the law, the starts, the ground and the effects of ``fitted``."""
    errors = {"fit_rmse_mm": fitted.fit_mm, "held_out_rmse_mm": fitted.held_out_mm}
    return fitted_twin(twin, fitted, simulation, {**twin.fit, "refined": errors})
