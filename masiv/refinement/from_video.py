"""Refine recordings of a body that is filmed: its trajectories, followed in pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.continuum.camera_split import CameraSplit
from masiv.identification.config import RENAMED_STARTS, IdentifyConfig
from masiv.models.free_body import FreeBodyModel
from masiv.mpm.config import SimulatorConfig
from masiv.observations.motion import Observed, first_frames
from masiv.progress import Progress, silent
from masiv.refinement.baselines import BaselineProblem, baselines
from masiv.refinement.config import RefineConfig
from masiv.refinement.experiment_design import propose
from masiv.refinement.prepare import prepare
from masiv.refinement.result import RefineResult
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import check_effects, refine
from masiv.scene.scene import Scene
from masiv.workers import workers_for

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
class Recording:
    """A motion that was filmed, of which the first ``fit_frames`` frames may be fitted. motion: of those, or more;
    whole: of all frames, of which only those after are taken. camera_split: the same motion from two sets of cameras,
    None if it is not known."""

    name: str
    scene: Scene
    motion: Observed
    whole: Observed
    fit_frames: int
    camera_split: CameraSplit | None = None


def split_frames(frame_count: int, fit_frames: int) -> int:
    """How many frames refine fits: those that identify did, or all but the last quarter if that was given all."""
    return fit_frames if fit_frames < frame_count else frame_count - max(1, frame_count // 4)


def with_unique_names(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings whose names differ: parameters are named after their recording, ``velocity_x@name``."""
    names: list[str] = []
    for recording in recordings:
        name, number = recording.name, 2
        while name in names:
            name, number = f"{recording.name}_{number}", number + 1
        names.append(name)
    return [replace(r, name=name) for r, name in zip(recordings, names, strict=True)]


def refine_recordings(
    recordings: Sequence[Recording],
    identify: IdentifyConfig,
    simulator: SimulatorConfig,
    config: RefineConfig,
    *,
    start: str | None = None,
    dry_run: bool = False,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> RefineResult:
    """Which effects does the model lack? recordings: of one body, fitted jointly; the first one chooses the laws.
    start: the twin's pretrained law, which chooses the competing classical laws unless ``config.laws`` does. dry_run:
    rank the effects, fit none.

    Raises InputError for an unknown effect in ``config.effects``, MasivError if no law explains the motion.
    """
    check_effects(config)
    start = RENAMED_STARTS.get(start or "", start)
    if not config.laws and start in COMPETITORS:
        config = config.model_copy(update={"laws": list(COMPETITORS[start])})
    with runtime.torch_threads(1), workers_for(config.processes, config.scheduler) as workers:
        prepared = [
            prepare(
                r.name,
                r.scene,
                first_frames(r.motion, r.fit_frames),
                r.whole,
                identify,
                simulator,
                config,
                camera_split=r.camera_split,
            )
            for r in with_unique_names(recordings)
        ]
        forward_model = FreeBodyModel([setup for setup, *_ in prepared])
        _, coarse, coarser, initial_motion = prepared[0]
        problem = BaselineProblem(coarse, coarser, min(initial_motion.last_frame + 2, coarse.problem.frames))
        fits = baselines(forward_model, problem, config, checkpoint or Checkpoint(None), progress, workers)
        settings = SearchSettings.of(config, rank_only=dry_run, workers=workers, progress=progress)
        result = refine(forward_model, fits, settings)
        proposal = None if dry_run else propose(result.search, progress, workers)
        return replace(result, proposal=proposal)
