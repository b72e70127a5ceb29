"""A rollout as a torch operation."""

from __future__ import annotations

import torch

from masiv.effects.active import ActiveEffects
from masiv.materials.law import Law
from masiv.mpm.simulator import Simulator
from masiv.mpm.spring_rollout import SpringRollout
from masiv.mpm.state import State
from masiv.mpm.taped_rollout import Adjoint, TapedRollout


class _Rollout(torch.autograd.Function):
    """Inputs after the plain arguments: state (4 tensors), the law's parameters, parameters of each effect."""

    @staticmethod
    def forward(
        ctx, simulator, law, steps, outputs, effects, rest, position, velocity, affine_velocity, trial_gradient, *others
    ):
        state = State(position, velocity, affine_velocity, trial_gradient, rest_position=rest)
        with torch.enable_grad():  # from parameters of effects to coefficients of kernels
            ctx.effects = _detached(effects) if effects is not None else None
            ctx.taped = simulator.run(state, law, steps, outputs, ctx.effects)
        ctx.dtypes = [t.dtype for t in state.tensors()]
        return ctx.taped.positions

    @staticmethod
    def backward(ctx, positions_bar):
        with torch.enable_grad():  # laws differentiate their networks inside
            adjoint = ctx.taped.backward(positions_bar)
        bars = [bar.to(dtype) for bar, dtype in zip(adjoint.state.tensors(), ctx.dtypes, strict=True)]
        return (
            None,
            None,
            None,
            None,
            None,
            None,
            *bars,
            *adjoint.law,
            *_effect_gradients(ctx.taped, ctx.effects, adjoint),
        )


def _detached(effects: ActiveEffects) -> ActiveEffects:
    members = tuple((effect, theta.detach().clone().requires_grad_()) for effect, theta in effects.members)
    return ActiveEffects(members, effects.context)


def _effect_gradients(
    taped: TapedRollout | SpringRollout, effects: ActiveEffects | None, adjoint: Adjoint
) -> list[torch.Tensor | None]:
    """Gradients of the effects' parameters, from the adjoints of coefficients, masses and forces."""
    if effects is None:
        return []
    outputs = [*taped.effects.coefficients, taped.mass]
    bars = [*adjoint.coefficients, adjoint.mass]
    if taped.effects.force is not None and adjoint.force is not None:
        outputs.append(taped.effects.force)
        bars.append(adjoint.force)
    used = [(o, b.to(o.dtype)) for o, b in zip(outputs, bars, strict=True) if o.requires_grad]
    if not used:
        return [None] * len(effects.members)
    return list(
        torch.autograd.grad(
            [o for o, _ in used], [t for _, t in effects.members], [b for _, b in used], allow_unused=True
        )
    )


def rollout(
    simulator: Simulator,
    law: Law,
    initial: State,
    steps: int,
    outputs: list[int],
    effects: ActiveEffects | None = None,
) -> torch.Tensor:
    """Positions (K, N, 3) [m, simulation frame] at the substeps ``outputs`` of ``steps`` substeps from ``initial``.

    Differentiable with respect to the initial state and the parameters of the law and of the effects. Bit-reproducible
    for a number of chunks. ``effects`` may also move the ground or the clock: that is the caller's to apply. Raises
    NonFiniteError.
    """
    thetas = [theta for _, theta in effects.members] if effects is not None else []
    given = (simulator, law, steps, outputs, effects, initial.rest_position)
    return _Rollout.apply(*given, *initial.tensors(), *law.parameters(), *thetas)


def at_rest(position: torch.Tensor, velocity: torch.Tensor, affine_velocity: torch.Tensor) -> State:
    """An undeformed body, F = I, with the given velocities."""
    eye = torch.eye(3, dtype=position.dtype).expand(len(position), 3, 3)
    return State(position, velocity, affine_velocity, eye)
