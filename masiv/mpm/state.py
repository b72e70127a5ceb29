"""The particles at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from masiv.errors import InputError

_SHAPES = {"position": (3,), "velocity": (3,), "affine_velocity": (3, 3), "trial_gradient": (3, 3)}


@dataclass(frozen=True)
class State:
    """Particles at one instant, simulation frame: position, velocity (N, 3) [m, m/s]; affine_velocity (N, 3, 3) [1/s];
    trial_gradient (N, 3, 3), the elastic deformation gradient before the return mapping. internal_variables (N, K) of
    the effect that has some (``HistoryEffect``); None: the body has been in its shape for long. rest_position
    (N, 3) [m]: where the particles of a body of springs are at rest; None: at ``position``. suspended (2, 3) [m, m/s]:
    position and velocity of the mass that hangs from the body (``SuspendedMassEffect``); None: it hangs straight down
    and moves with the body. A rollout has no gradient by these three."""

    position: torch.Tensor
    velocity: torch.Tensor
    affine_velocity: torch.Tensor
    trial_gradient: torch.Tensor
    internal_variables: torch.Tensor | None = None
    rest_position: torch.Tensor | None = None
    suspended: torch.Tensor | None = None

    def tensors(self) -> tuple[torch.Tensor, ...]:
        return self.position, self.velocity, self.affine_velocity, self.trial_gradient

    def check(self, count: int) -> None:
        """Raises InputError if a tensor is not of ``count`` particles."""
        for name, shape in _SHAPES.items():
            given = tuple(getattr(self, name).shape)
            if given != (count, *shape):
                raise InputError(f"initial state: {name} has shape {given}, the simulator needs {(count, *shape)}")

    @staticmethod
    def empty(count: int, dtype: torch.dtype) -> State:
        """Memory for ``count`` particles."""
        return State(*(torch.empty(count, *shape, dtype=dtype) for shape in _SHAPES.values()))
