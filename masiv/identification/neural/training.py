"""Training of a law through rollouts: the law, initial velocity, spin and effective ground are fitted jointly.

MASIV, section "Material-Agnostic System Identification", eqs. 8 to 10. Differences: the initial velocity is fitted with
the law and not before it; there is a color term, and a prior that keeps what the motion does not determine.
"""

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
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.training_state import TrainingState
from masiv.identification.recording import FitRecording
from masiv.materials.adapter import AdapterLaw
from masiv.materials.neural import NeuralLaw
from masiv.models.filmed_body import REST_CELLS
from masiv.models.initial_state import InitialState
from masiv.progress import Progress


@dataclass(frozen=True)
class _RolloutErrors:
    """Mean distances (K,) to the trajectories [m] at each instant, silhouette error (), and the objective if the
    rollout was over all frames of the fit."""

    frames: int
    by_instant: torch.Tensor
    silhouette: float
    objective: float | None

    @property
    def trajectory(self) -> float:
        """Mean distance to the trajectories [m]."""
        return float(self.by_instant.mean())


@dataclass
class TrainingResult:
    """The best parameters so far.

    initial_states: one of each recording. trajectory_error: mean distance to the trajectories [m] over the frames of
    the fit; objective: mean over the recordings. history: (iteration, frames, trajectory error [m], silhouette error).
    """

    law: NeuralLaw | AdapterLaw
    initial_states: tuple[InitialState, ...]
    trajectory_error: float = math.inf
    objective: float = math.inf
    history: list[tuple[int, int, float, float]] = field(default_factory=list)

    def update(
        self,
        rollouts: Sequence[_RolloutErrors],
        law: NeuralLaw | AdapterLaw,
        initial_states: Sequence[InitialState],
    ) -> None:
        """Take ``law`` and ``initial_states`` if all ``rollouts`` are over all frames of the fit and their objective is
        less."""
        objectives = [r.objective for r in rollouts if r.objective is not None]
        if len(objectives) == len(rollouts) and mean(objectives) < self.objective:
            self.objective, self.trajectory_error = mean(objectives), mean(r.trajectory for r in rollouts)
            self.law, self.initial_states = copy.deepcopy(law), _copied(initial_states)

    def state(self) -> dict[str, Any]:
        """Plain values and tensors, for ``from_state``."""
        return {
            "law": self.law.state_dict(),
            "initial_states": [list(state.tensors()) for state in self.initial_states],
            "trajectory_error": self.trajectory_error,
            "objective": self.objective,
            "history": self.history,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], law: NeuralLaw | AdapterLaw) -> TrainingResult:
        """The result of a ``state``; its weights are loaded into ``law``, which must be of the same kind and width.

        Raises MasivError for the state of an older version.
        """
        if not {"objective", "initial_states"} <= state.keys():
            raise MasivError(
                "identify: the checkpoint was written by an older version of masiv: delete checkpoints/ in the run "
                "folder and run the command again"
            )
        law.load_state_dict(state["law"])
        rows = [tuple(row) for row in state["history"]]
        initial_states = tuple(InitialState(*tensors) for tensors in state["initial_states"])
        return cls(law, initial_states, state["trajectory_error"], state["objective"], rows)

    def history_rows(self) -> list[dict[str, float]]:
        """The history with named values, as the twin keeps it."""
        return [
            {"iteration": i, "frames": k, "trajectory_error_mm": 1e3 * e, "silhouette": s}
            for i, k, e, s in self.history
        ]


def train(
    recordings: Sequence[FitRecording],
    law: NeuralLaw | AdapterLaw,
    contact: str,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
    prior: NeuralLaw | None = None,
    label: str = "identify: fit",
) -> TrainingResult:
    """Minimise the mean objective over ``recordings`` of one body with Adam, from ``law``, which is not changed.

    The horizon grows from the first frames of each recording to its last (``FitRecording.frames``) over the first half
    of the iterations. If a rollout diverges, the last step is undone, the step sizes are halved and the horizon ends a
    frame earlier; both recover with successful steps. A step after which the distance to the trajectories is
    ``WORSE`` times as large is halved. Returns the parameters with the least objective over all these frames. prior:
    the law to which a neural law is drawn; ``law`` if None. Raises MasivError if rollouts keep diverging.
    """
    config = recordings[0].objective.config
    drawn_to, law = prior or law, copy.deepcopy(law)
    initial_states = [
        InitialState(*(t.detach().clone().requires_grad_() for t in r.initial_state.tensors())) for r in recordings
    ]
    training = TrainingState(law, initial_states, config, max(r.frames for r in recordings))
    resolution = REST_CELLS * mean(r.objective.problem.spacing for r in recordings)
    best = TrainingResult(copy.deepcopy(law), _copied(initial_states))
    first = _restored(checkpoint, training, best)
    for i in range(first, config.iterations):
        checkpoint.maybe_save(functools.partial(_checkpoint_state, i, training, best))
        training.schedule(i / config.iterations)
        rollouts: list[_RolloutErrors] = []
        frames = 0
        try:
            for k, (recording, initial_state) in enumerate(zip(recordings, initial_states, strict=True)):
                frames = min(training.horizon, _scheduled_horizon(i, config.iterations, recording))
                rollouts.append(
                    _backpropagate(
                        recording, law, initial_state, contact, frames,
                        prior_loss=_prior_loss(law, drawn_to, config.prior_weight),
                        weight=1 / len(recordings), seed=(seed, i, k),
                    )
                )  # fmt: skip
            best.update(rollouts, law, initial_states)
            if not training.gradient_is_finite:
                substeps = frames * recordings[-1].objective.problem.substeps(law)
                raise NonFiniteError(substeps, 0, "the adjoint overflowed")
        except NonFiniteError as diverged:
            training.back_off(frames, diverged)
            continue
        frames, error = max(r.frames for r in rollouts), mean(r.trajectory for r in rollouts)
        best.history.append((i, frames, error, mean(r.silhouette for r in rollouts)))
        errors = [r.by_instant for r in rollouts]
        if training.is_worse(errors, resolution):
            training.halve_step()
        else:
            training.step(errors)
        progress(label, i + 1, config.iterations, f"{1e3 * error:.1f} mm over {frames} frames")
    if math.isinf(best.objective):  # no iteration reached the last frame
        training.undo()
        whole = [_whole_rollout(r, s, law, contact) for r, s in zip(recordings, initial_states, strict=True)]
        best.update(whole, law, initial_states)
    return best


def _backpropagate(
    recording: FitRecording,
    law: NeuralLaw | AdapterLaw,
    initial_state: InitialState,
    contact: str,
    frames: int,
    *,
    prior_loss: torch.Tensor,
    weight: float,
    seed: tuple[int, ...],
) -> _RolloutErrors:
    """Add ``weight`` times the gradient of a recording's objective and ``prior_loss`` () to the parameters' gradient.

    Raises NonFiniteError.
    """
    objective = recording.objective
    positions = objective.problem.run(law, initial_state, contact, frames)
    by_instant = objective.trajectory_errors(positions)
    trajectory_error = by_instant.mean()
    image_errors = _sampled_image_errors(objective, positions, frames, seed)
    on_paths = objective.config.geometry_loss == "trajectory"
    geometry_error = trajectory_error if on_paths else objective.geometry_error(positions)
    loss = objective.loss(geometry_error, image_errors) + prior_loss
    errors = _RolloutErrors(
        frames,
        by_instant.detach(),
        float(image_errors[0].detach()),
        objective.evaluate(positions) if frames == recording.frames else None,
    )
    (weight * loss).backward()
    return errors


@torch.no_grad()
def _whole_rollout(
    recording: FitRecording, initial_state: InitialState, law: NeuralLaw | AdapterLaw, contact: str
) -> _RolloutErrors:
    """The errors of a rollout over all frames of the fit."""
    objective, frames = recording.objective, recording.frames
    positions = objective.problem.run(law, initial_state, contact, frames)
    return _RolloutErrors(frames, objective.trajectory_errors(positions), 0.0, objective.evaluate(positions))


def whole_trajectory_error(recordings: Sequence[FitRecording], trained: TrainingResult, contact: str) -> float:
    """Mean distance to the trajectories [m] over all frames of ``recordings``, those at rest included.

    Raises NonFiniteError if a rollout diverges after the frames of the fit.
    """
    if all(r.frames == r.objective.problem.frames for r in recordings):
        return trained.trajectory_error
    return mean(
        float(r.objective.trajectory_errors(r.objective.whole_rollout(trained.law, state, contact)).mean())
        for r, state in zip(recordings, trained.initial_states, strict=True)
    )


def _prior_loss(law: NeuralLaw | AdapterLaw, prior: NeuralLaw | AdapterLaw, weight: float) -> torch.Tensor:
    """``weight`` times the distance () of a neural law from ``prior``; 0 for an adapter."""
    if isinstance(law, NeuralLaw) and isinstance(prior, NeuralLaw) and weight:
        return weight * law.prior_distance(prior)
    return torch.zeros(())


def _copied(initial_states: Sequence[InitialState]) -> tuple[InitialState, ...]:
    return tuple(InitialState(*(t.detach().clone() for t in state.tensors())) for state in initial_states)


def _scheduled_horizon(iteration: int, iterations: int, recording: FitRecording) -> int:
    """Frames of the rollouts of an iteration."""
    first, last = recording.first_frames, recording.frames
    frames = first + (last - first) * min(1.0, 2 * iteration / max(iterations, 1))
    return min(last, max(1, round(frames)))


def _sampled_image_errors(
    objective: Objective, positions: torch.Tensor, frames: int, seed: tuple[int, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean errors of silhouettes and colors in a few pictures, drawn at random with ``seed``."""
    if not objective.compares_images:
        return torch.zeros(()), torch.zeros(())
    random = np.random.default_rng(seed)
    pictures = []
    for _ in range(objective.config.pictures):
        frame = int(random.integers(1, frames + 1))
        pictures.append((frame, int(random.choice(objective.problem.scene.views))))
    return objective.images.errors(positions, pictures)


def _checkpoint_state(iteration: int, training: TrainingState, best: TrainingResult) -> dict[str, Any]:
    return {"fit": {"iteration": iteration, **training.state(), "best": best.state()}}


def _restored(checkpoint: Checkpoint, training: TrainingState, best: TrainingResult) -> int:
    """Load ``training`` and ``best`` from ``checkpoint``. Returns the next iteration; 0 if nothing is saved."""
    saved = (checkpoint.load() or {}).get("fit")
    if saved is None:
        return 0
    kept = TrainingResult.from_state(saved["best"], best.law)
    training.restore(saved)
    best.initial_states, best.history = kept.initial_states, kept.history
    best.trajectory_error, best.objective = kept.trajectory_error, kept.objective
    return saved["iteration"]
