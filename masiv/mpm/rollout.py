"""A rollout as a torch operation."""

from __future__ import annotations

import torch

from masiv.materials.law import Law
from masiv.mpm.simulator import Simulator, State


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx, simulator, law, steps, outputs, position, velocity, affine_velocity, trial_gradient, *parameters):
        state = State(position, velocity, affine_velocity, trial_gradient)
        ctx.recording = simulator.run(state, law, steps, outputs)
        ctx.dtypes = [t.dtype for t in state.tensors()]
        return ctx.recording.positions

    @staticmethod
    def backward(ctx, positions_bar):
        with torch.enable_grad():  # laws differentiate their networks inside
            state_bar, parameter_bars = ctx.recording.backward(positions_bar)
        bars = [bar.to(dtype) for bar, dtype in zip(state_bar.tensors(), ctx.dtypes, strict=True)]
        return None, None, None, None, *bars, *parameter_bars


def rollout(simulator: Simulator, law: Law, initial: State, steps: int, outputs: list[int]) -> torch.Tensor:
    """Positions (K, N, 3) [m, simulation frame] at the substeps ``outputs`` of ``steps`` substeps from ``initial``.

    Differentiable with respect to the initial state and the parameters of the law. Bit-reproducible for a number of
    chunks. Raises NonFiniteError.
    """
    return _Rollout.apply(simulator, law, steps, outputs, *initial.tensors(), *law.parameters())


def at_rest(position: torch.Tensor, velocity: torch.Tensor, affine_velocity: torch.Tensor) -> State:
    """An undeformed body, F = I, with the given velocities."""
    eye = torch.eye(3, dtype=position.dtype).expand(len(position), 3, 3)
    return State(position, velocity, affine_velocity, eye)
