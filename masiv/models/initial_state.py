"""How a free body begins to move: velocity, spin and the height of the effective ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from masiv.models.parameters import Parameter
from masiv.mpm.rollout import at_rest
from masiv.mpm.state import State
from masiv.rigid import beyond_rigid, first_contact_frame, free_flight
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame

CONTACT_QUANTILE = 0.01
"""The body touches the ground if this part of its particles is near it."""
VELOCITY_RANGE, VELOCITY_STEP = 3.0, 0.02
"""Range to either side of the estimate and finite-difference step [m/s]."""
OMEGA_RANGE, OMEGA_STEP = 6.0, 0.05
"""[rad/s]"""
GROUND_STEP = 2e-3
"""[m]"""


@dataclass
class InitialState:
    """Parameters of one recording, simulation frame: velocity (3,) [m/s] of the centroid, omega (3,) [rad/s],
    ground_offset () [m], how far the effective ground lies above the scene's."""

    velocity: torch.Tensor
    omega: torch.Tensor
    ground_offset: torch.Tensor

    @classmethod
    def of_world(
        cls, axes: SimulationFrame, velocity: np.ndarray, omega: np.ndarray, ground_offset: float = 0.0
    ) -> InitialState:
        """From velocity (3,) [m/s] and omega (3,) [rad/s] in the world frame."""
        v, w = (torch.as_tensor(axes.vectors_to_simulation(v), dtype=torch.float32) for v in (velocity, omega))
        return cls(v, w, torch.tensor(ground_offset, dtype=torch.float32))

    @classmethod
    def of_values(cls, values: Mapping[str, float]) -> InitialState:
        """From values of ``initial_state_parameters`` by name."""
        return cls(
            torch.tensor([values[f"velocity_{a}"] for a in "xyz"], dtype=torch.float32),
            torch.tensor([values[f"omega_{a}"] for a in "xyz"], dtype=torch.float32),
            torch.tensor(values.get("ground_offset", 0.0), dtype=torch.float32),
        )

    def tensors(self) -> tuple[torch.Tensor, ...]:
        """Velocity, omega, ground_offset."""
        return self.velocity, self.omega, self.ground_offset

    def ground(self, of_scene: Ground | None) -> Ground | None:
        """The effective ground."""
        if of_scene is None:
            return None
        return Ground(of_scene.normal, of_scene.height + float(self.ground_offset))


@dataclass(frozen=True)
class InitialMotion:
    """velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] at frame 0, world frame, estimated from frames
    0…last_frame."""

    velocity: np.ndarray
    omega: np.ndarray
    last_frame: int


def initial_state_parameters(start: InitialState, ground_range: float) -> tuple[Parameter, ...]:
    """Velocity [m/s], spin [rad/s] and the ground's offset [m], with bounds around ``start``.

    ground_range [m]: greatest size of the offset; 0 if there is no ground, which leaves the offset out.
    """
    parameters = []
    for name, tensor, reach, step in (
        ("velocity", start.velocity, VELOCITY_RANGE, VELOCITY_STEP),
        ("omega", start.omega, OMEGA_RANGE, OMEGA_STEP),
    ):
        for axis, value in zip("xyz", tensor.double().tolist(), strict=True):
            parameters.append(Parameter(f"{name}_{axis}", value, value - reach, value + reach, step))
    if ground_range > 0:
        offset = float(np.clip(float(start.ground_offset), -ground_range, ground_range))
        parameters.append(Parameter("ground_offset", offset, -ground_range, ground_range, GROUND_STEP))
    return tuple(parameters)


def skew(omega: torch.Tensor) -> torch.Tensor:
    """The matrix W (3, 3) with W r = omega x r."""
    x, y, z = omega.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def rigid_initial_state(position: torch.Tensor, velocity: torch.Tensor, omega: torch.Tensor) -> State:
    """An undeformed body (N, 3) [m] with the velocity (3,) [m/s] of its centroid and a spin (3,) [rad/s] about it."""
    spin = skew(omega)
    arm = position - position.mean(0)
    return at_rest(position, velocity + arm @ spin.T, spin.expand(len(position), 3, 3))


def estimate_initial_motion(
    positions: np.ndarray, times: np.ndarray, gravity: np.ndarray, ground: Ground | None, clearance: float
) -> InitialMotion:
    """Least squares on free flight.

    positions (T, N, 3) [m] at times (T,) [s]. Flight ends before the first frame whose lowest hundredth of particles is
    within ``clearance`` [m] of the ground, or before the body suddenly stops to move rigidly (it may hit something that
    was not declared). If that happens at once, frames 0 and 1 are used.
    """
    last = len(times) - 1
    if ground is not None:
        heights = np.quantile(positions @ ground.normal - ground.height, CONTACT_QUANTILE, axis=1)
        touching = np.flatnonzero(heights[1:] < clearance)
        if len(touching):
            last = max(1, int(touching[0]))
    last = first_contact_frame(beyond_rigid(positions[: last + 1]))
    return InitialMotion(*free_flight(positions[: last + 1], times[: last + 1], gravity), last)
