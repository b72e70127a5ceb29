"""The state of a training run: parameters, Adam, and the step size and horizon that shrink if a rollout diverges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

import torch

from masiv.errors import MasivError, NonFiniteError
from masiv.identification.config import IdentifyConfig
from masiv.materials.adapter import AdapterLaw
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState

MAX_FAILURES = 8
"""Diverged rollouts in a row after which the training stops, or halvings of one step after which it is accepted."""
WORSE = 2.0
"""A step is halved if it makes the distance to the trajectories this many times as large. Chosen: such a step moves the
body farther than it was off."""
LR_RECOVERY = 1.4
"""Factor by which reduced step sizes grow with each successful step."""
MAX_GRADIENT_NORM = 1.0
"""Norm to which the gradient of each parameter group is clipped."""
ADAM_BETAS = 0.9, 0.95
MIN_LR = 0.05
"""Step size at the end of the cosine schedule, as a fraction of that at the start."""


class TrainingState:
    """Adam over ``law`` and ``initial_states``, which are changed in place.

    horizon: maximum number of frames of a rollout, at most ``max_frames``.
    """

    def __init__(
        self,
        law: NeuralLaw | AdapterLaw,
        initial_states: Sequence[InitialState],
        config: IdentifyConfig,
        max_frames: int,
    ) -> None:
        if isinstance(law, NeuralLaw):
            scales, weights = law.scales(), [*law.elastic.parameters(), *law.plastic.parameters()]
        else:
            scales, weights = [], [p for p in law.parameters() if p.requires_grad]
        groups = [
            (weights, config.law_learning_rate),
            (scales, config.scale_learning_rate),
            ([t for state in initial_states for t in (state.velocity, state.omega)], config.velocity_learning_rate),
            ([state.ground_offset for state in initial_states], config.ground_learning_rate),
        ]
        self._optimizer = torch.optim.Adam(
            [{"params": p, "lr": rate, "max_lr": rate} for p, rate in groups if p], betas=ADAM_BETAS
        )
        self._parameters = [*weights, *scales, *(t for state in initial_states for t in state.tensors())]
        self._ground_offsets = [state.ground_offset for state in initial_states]
        self._ground_range = config.ground_range
        self._max_frames = self.horizon = max_frames
        self._lr_backoff, self._failures = 1.0, 0
        self._errors: list[torch.Tensor] = []
        self.accept()

    def schedule(self, progress: float) -> None:
        """Zero the gradient and set the step sizes of a cosine schedule at ``progress`` in [0, 1]."""
        cosine = 0.5 * (1 + math.cos(math.pi * progress))
        for group in self._optimizer.param_groups:
            group["lr"] = group["max_lr"] * self._lr_backoff * (MIN_LR + (1 - MIN_LR) * cosine)
        self._optimizer.zero_grad()

    @property
    def gradient_is_finite(self) -> bool:
        return all(bool(torch.isfinite(p.grad).all()) for p in self._parameters if p.grad is not None)

    def accept(self) -> None:
        """Remember the parameters: their rollouts have succeeded."""
        self._accepted = [p.detach().clone() for p in self._parameters]

    def is_worse(self, errors: Sequence[torch.Tensor], resolution: float) -> bool:
        """Whether distances to the trajectories [m] are more than ``WORSE`` times those of the accepted parameters.

        errors: of each recording (K,), means at its first K instants. Compared are the instants that both have.
        resolution [m]: smaller distances count as this one.
        """
        if not self._errors or self._failures >= MAX_FAILURES:
            return False
        pairs = [(b[: len(a)], a[: len(b)]) for b, a in zip(self._errors, errors, strict=True)]
        before, after = (fmean(float(e.mean()) for e in side) for side in zip(*pairs, strict=True))
        return after > WORSE * max(before, resolution)

    def step(self, errors: Sequence[torch.Tensor]) -> None:
        """Accept the parameters, whose ``errors`` are as in ``is_worse``, then step along the gradient."""
        self.accept()
        self._errors = list(errors)
        self._failures, self._lr_backoff = 0, min(1.0, LR_RECOVERY * self._lr_backoff)
        self.horizon = min(self._max_frames, self.horizon + 1)
        for group in self._optimizer.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], MAX_GRADIENT_NORM)
        self._optimizer.step()
        with torch.no_grad():
            for offset in self._ground_offsets:
                offset.clamp_(-self._ground_range, self._ground_range)

    def undo(self) -> None:
        """Return to the parameters that were accepted last."""
        with torch.no_grad():
            for parameter, value in zip(self._parameters, self._accepted, strict=True):
                parameter.copy_(value)

    def halve_step(self) -> None:
        """Go back half of the last step, and halve the step sizes to come.

        Backtracking: Nocedal & Wright, Numerical Optimization, 2006, section 3.1.
        """
        self._failures, self._lr_backoff = self._failures + 1, self._lr_backoff / 2
        with torch.no_grad():
            for parameter, value in zip(self._parameters, self._accepted, strict=True):
                parameter.lerp_(value, 0.5)

    def back_off(self, frames: int, diverged: NonFiniteError) -> None:
        """Undo the last step, after which a rollout of ``frames`` frames diverged; halve the step sizes and shorten the
        horizon. Raises MasivError after ``MAX_FAILURES`` in a row."""
        self._failures, self._lr_backoff, self.horizon = self._failures + 1, self._lr_backoff / 2, max(1, frames - 1)
        if self._failures > MAX_FAILURES:
            raise MasivError(f"identify: the fit keeps diverging ({diverged})") from diverged
        self.undo()

    def state(self) -> dict[str, Any]:
        """Plain values and tensors, for ``restore``."""
        return {
            "lr_backoff": self._lr_backoff,
            "failures": self._failures,
            "horizon": self.horizon,
            "errors": self._errors,
            "accepted": self._accepted,
            "parameters": [p.detach() for p in self._parameters],
            "optimizer": self._optimizer.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a ``state``."""
        with torch.no_grad():
            for parameter, value in zip(self._parameters, state["parameters"], strict=True):
                parameter.copy_(value)
        self._optimizer.load_state_dict(state["optimizer"])
        self._lr_backoff, self._failures, self.horizon = state["lr_backoff"], state["failures"], state["horizon"]
        self._errors, self._accepted = state["errors"], state["accepted"]
