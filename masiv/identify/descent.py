"""Adam over a law and the motions of its throws, which goes more carefully after a rollout that diverged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from masiv.errors import MasivError, NonFiniteError
from masiv.identify.config import IdentifyConfig
from masiv.materials.adapter import AdapterLaw
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState

FAILURES_ALLOWED = 8
RECOVERY = 1.4
"""Step sizes that were halved grow by this factor with every step that succeeds."""
LARGEST_GRADIENT = 1.0
"""Norm of the gradient of what shares a step size."""


class Descent:
    """``law`` and ``motions`` are moved in place. reach: frames that a rollout may have, ``longest`` at most."""

    def __init__(
        self, law: NeuralLaw | AdapterLaw, motions: Sequence[InitialState], config: IdentifyConfig, longest: int
    ) -> None:
        if isinstance(law, NeuralLaw):
            scales, weights = law.scales(), [*law.elastic.parameters(), *law.plastic.parameters()]
        else:
            scales, weights = [], [p for p in law.parameters() if p.requires_grad]
        groups = [
            (weights, config.law_learning_rate),
            (scales, config.scale_learning_rate),
            ([t for motion in motions for t in (motion.velocity, motion.omega)], config.velocity_learning_rate),
            ([motion.ground_offset for motion in motions], config.ground_learning_rate),
        ]
        self._optimiser = torch.optim.Adam(
            [{"params": p, "lr": rate, "rate": rate} for p, rate in groups if p], betas=(0.9, 0.95)
        )
        self._parameters = [*weights, *scales, *(t for motion in motions for t in motion.tensors())]
        self._grounds = [motion.ground_offset for motion in motions]
        self._ground_range = config.ground_range
        self._longest = self.reach = longest
        self._caution, self._failures = 1.0, 0
        self.accept()

    def begin(self, done: float) -> None:
        """No gradient, and step sizes for when ``done``, 0 to 1, of the fit is."""
        decay = 0.5 * (1 + math.cos(math.pi * done))
        for group in self._optimiser.param_groups:
            group["lr"] = group["rate"] * self._caution * (0.05 + 0.95 * decay)
        self._optimiser.zero_grad()

    @property
    def finite(self) -> bool:
        """Whether the gradient is."""
        return all(bool(torch.isfinite(p.grad).all()) for p in self._parameters if p.grad is not None)

    def accept(self) -> None:
        """PathResidual of the parameters as they are have succeeded."""
        self._accepted = [p.detach().clone() for p in self._parameters]

    def step(self) -> None:
        """From parameters that are accepted along the gradient."""
        self.accept()
        self._failures, self._caution = 0, min(1.0, RECOVERY * self._caution)
        self.reach = min(self._longest, self.reach + 1)
        for group in self._optimiser.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], LARGEST_GRADIENT)
        self._optimiser.step()
        with torch.no_grad():
            for ground in self._grounds:
                ground.clamp_(-self._ground_range, self._ground_range)

    def take_back(self) -> None:
        """The last step."""
        with torch.no_grad():
            for parameter, value in zip(self._parameters, self._accepted, strict=True):
                parameter.copy_(value)

    def failed(self, frames: int, diverged: NonFiniteError) -> None:
        """Take the last step back, after which a rollout over ``frames`` ``diverged``, and go on with half the step
        sizes over fewer frames. Raises MasivError after several in a row."""
        self._failures, self._caution, self.reach = self._failures + 1, self._caution / 2, max(1, frames - 1)
        if self._failures > FAILURES_ALLOWED:
            raise MasivError(f"identify: the fit keeps diverging ({diverged})") from diverged
        self.take_back()

    def state(self) -> dict[str, Any]:
        """What ``restore`` goes on from."""
        return {
            "caution": self._caution,
            "failures": self._failures,
            "reach": self.reach,
            "parameters": [p.detach() for p in self._parameters],
            "optimiser": self._optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state``."""
        with torch.no_grad():
            for parameter, value in zip(self._parameters, state["parameters"], strict=True):
                parameter.copy_(value)
        self._optimiser.load_state_dict(state["optimiser"])
        self._caution, self._failures, self.reach = state["caution"], state["failures"], state["reach"]
        self.accept()
