"""The joint fit of law, initial velocity and effective ground through the rollouts of one throw or several."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import fmean as mean
from typing import Any

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError, NonFiniteError
from masiv.identify.descent import Descent
from masiv.identify.objective import objective
from masiv.identify.pictures import compared, picture_errors, picture_objective
from masiv.identify.problem import Problem
from masiv.identify.throw import Throw
from masiv.materials.adapter import AdapterLaw
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState
from masiv.progress import Progress


@dataclass
class Fit:
    """A law and the motion of each throw; error_m is the mean distance to the trajectories over all fitted frames;
    objective: what was made small, there; history: (iteration, frames, trajectory error [m], silhouette error)."""

    law: NeuralLaw | AdapterLaw
    motions: tuple[InitialState, ...]
    error_m: float = math.inf
    objective: float = math.inf
    history: list[tuple[int, int, float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class _Pass:
    """One rollout of a throw: mean distance to the trajectories [m], silhouettes' error, and the objective where the
    rollout was over all frames."""

    frames: int
    error: float
    outline: float
    objective: float | None


def fit(
    throws: Sequence[Throw],
    law: NeuralLaw | AdapterLaw,
    contact: str,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
    prior: NeuralLaw | None = None,
) -> Fit:
    """Adam on the mean over ``throws`` of one body, on a horizon that grows from each one's first frames to all frames
    over the first half of the iterations.

    A rollout that diverges is not repaired: the step is taken back, the step sizes are halved and the horizon ends a
    frame earlier, both until steps succeed again; after several in a row the stage stops. Returns the parameters with
    the least error over all frames. prior: what a neural law is drawn to, ``law`` where None. Raises MasivError.
    """
    config = throws[0].problem.config
    start, law = prior or law, copy.deepcopy(law)
    motions = [InitialState(*(t.detach().clone().requires_grad_() for t in throw.motion.tensors())) for throw in throws]
    descent = Descent(law, motions, config, max(throw.problem.frames for throw in throws))
    best = Fit(copy.deepcopy(law), _copied(motions))
    first = 0
    saved = checkpoint.load()
    if saved is not None and "fit" in saved:
        first = _restore(saved["fit"], descent, best)
    for i in range(first, config.iterations):
        state = functools.partial(_state, i, descent, best)
        checkpoint.maybe_save(lambda state=state: {"fit": state()})
        descent.begin(i / config.iterations)
        passed: list[_Pass] = []
        frames = 0
        try:
            for k, (throw, motion) in enumerate(zip(throws, motions, strict=True)):
                frames = min(descent.reach, _horizon(i, config.iterations, throw.first_frames, throw.problem.frames))
                departure = torch.zeros(())
                if isinstance(law, NeuralLaw) and isinstance(start, NeuralLaw) and config.prior_weight:
                    departure = config.prior_weight * law.departure(start)
                passed.append(
                    _descend(throw.problem, law, motion, contact, frames, departure, 1 / len(throws), (seed, i, k))
                )
            _keep_better(best, passed, law, motions)
            if not descent.finite:
                raise NonFiniteError(frames * throws[-1].problem.substeps(law), 0, "the adjoint overflowed")
        except NonFiniteError as diverged:
            descent.failed(frames, diverged)
            continue
        frames, error = max(p.frames for p in passed), mean(p.error for p in passed)
        best.history.append((i, frames, error, mean(p.outline for p in passed)))
        descent.step()
        progress("identify: fit", i + 1, config.iterations, f"{1e3 * error:.1f} mm over {frames} frames")
    if math.isinf(best.objective):  # no step reached the last frame
        descent.take_back()
        _keep_better(best, [_whole(*one, law, contact) for one in zip(throws, motions, strict=True)], law, motions)
    return best


def _descend(
    problem: Problem,
    law: NeuralLaw | AdapterLaw,
    motion: InitialState,
    contact: str,
    frames: int,
    departure: torch.Tensor,
    share: float,
    seed: tuple[int, ...],
) -> _Pass:
    """Add a throw's ``share`` to the gradient. departure: what the law pays for its own. Raises NonFiniteError."""
    config = problem.config
    positions = problem.run(law, motion, contact, frames)
    error = problem.error(positions)
    outline, paint = _pictures(problem, positions, frames, seed)
    geometry = error if config.geometry_loss == "trajectory" else problem.geometry_error(positions)
    loss = config.trajectory_weight * geometry / problem.size
    loss = loss + picture_objective(problem, (outline, paint)) + departure
    here = objective(problem, positions) if frames == problem.frames else None
    (share * loss).backward()
    return _Pass(frames, float(error.detach()), float(outline.detach()), here)


@torch.no_grad()
def _whole(throw: Throw, motion: InitialState, law: NeuralLaw | AdapterLaw, contact: str) -> _Pass:
    """A rollout over all frames."""
    problem = throw.problem
    positions = problem.run(law, motion, contact, problem.frames)
    return _Pass(problem.frames, float(problem.error(positions)), 0.0, objective(problem, positions))


def _copied(motions: Sequence[InitialState]) -> tuple[InitialState, ...]:
    return tuple(InitialState(*(t.detach().clone() for t in motion.tensors())) for motion in motions)


def _keep_better(
    best: Fit, passed: Sequence[_Pass], law: NeuralLaw | AdapterLaw, motions: Sequence[InitialState]
) -> None:
    """Put law and motions into ``best`` where their rollouts, all over all frames, are nearer to what was observed."""
    objectives = [p.objective for p in passed if p.objective is not None]
    if len(objectives) == len(passed) and mean(objectives) < best.objective:
        best.objective, best.error_m = mean(objectives), mean(p.error for p in passed)
        best.law, best.motions = copy.deepcopy(law), _copied(motions)


def _horizon(iteration: int, iterations: int, first: int, last: int) -> int:
    grown = first + (last - first) * min(1.0, 2 * iteration / max(iterations, 1))
    return min(last, max(1, round(grown)))


def _pictures(
    problem: Problem, positions: torch.Tensor, frames: int, seed: tuple[int, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean errors of silhouettes and paint in a few pictures drawn from ``seed``."""
    if not compared(problem):
        return torch.zeros(()), torch.zeros(())
    random = np.random.default_rng(seed)
    pictures = []
    for _ in range(problem.config.pictures):
        frame = int(random.integers(1, frames + 1))
        pictures.append((frame, int(random.choice(problem.scene.views))))
    return picture_errors(problem, positions, pictures)


def fit_state(found: Fit) -> dict:
    """What ``fit_from`` makes the same fit of."""
    return {
        "law": found.law.state_dict(),
        "motions": [list(motion.tensors()) for motion in found.motions],
        "error_m": found.error_m,
        "objective": found.objective,
        "history": found.history,
    }


def fit_from(state: dict, law: NeuralLaw | AdapterLaw) -> Fit:
    """The fit of ``state``; ``law``, of its kind and width, becomes its law. Raises MasivError for a state that was
    chosen by something else."""
    if not {"objective", "motions"} <= state.keys():
        raise MasivError(
            "identify: the checkpoint is of an older masiv, whose fits were chosen otherwise: delete what is in "
            "checkpoints/ of the run folder and run the command again"
        )
    law.load_state_dict(state["law"])
    rows = [tuple(row) for row in state["history"]]
    motions = tuple(InitialState(*tensors) for tensors in state["motions"])
    return Fit(law, motions, state["error_m"], state["objective"], rows)


def _state(iteration: int, descent: Descent, best: Fit) -> dict[str, Any]:
    return {"iteration": iteration, **descent.state(), "best": fit_state(best)}


def _restore(state: dict[str, Any], descent: Descent, best: Fit) -> int:
    """The iteration that ``descent`` and ``best`` go on with."""
    kept = fit_from(state["best"], best.law)
    descent.restore(state)
    best.motions, best.error_m, best.objective, best.history = (
        kept.motions, kept.error_m, kept.objective, kept.history
    )  # fmt: skip
    return state["iteration"]
