"""Differentiate through the simulator: how the height of a block depends on its initial velocity.

    python examples/gradient_of_a_rollout.py          (seconds)

The gradient is the hand-written adjoint of MPM; it is compared with a central difference."""

import torch

from masiv import runtime
from masiv.materials.classical import ClassicalLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator

STEPS, SUBSTEP, SPACING = 400, 2e-4, 0.04


def height(speed: torch.Tensor, law: ClassicalLaw) -> torch.Tensor:
    """Mean height [m] of a 0.2 m block, dropped from 0.1 m onto the ground with a vertical ``speed`` () [m/s]."""
    axis = (torch.arange(10).double() + 0.5) * 0.02
    block = torch.stack(torch.meshgrid(axis, axis + 0.1, axis, indexing="ij"), -1).reshape(-1, 3)
    simulator = Simulator(particle_count=len(block), spacing=SPACING, substep=SUBSTEP, volume=0.2**3, density=1000.0,
                          gravity=(0.0, -9.8, 0.0), contact="sticky", dtype=torch.float64)  # fmt: skip
    velocity = torch.stack([torch.zeros(()), speed, torch.zeros(())]).double()
    state = rigid_initial_state(block, velocity, torch.zeros(3, dtype=torch.float64))
    return rollout(simulator, law, state, STEPS, [STEPS])[0, :, 1].mean()


def main() -> tuple[float, float]:
    runtime.start("cpu")
    law = ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3)
    speed = torch.tensor(-3.0, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(speed, law), speed)
    with torch.no_grad():
        difference = (height(speed + 1e-4, law) - height(speed - 1e-4, law)) / 2e-4
    return float(gradient), float(difference)


if __name__ == "__main__":
    print("adjoint {:.8f} s, central difference {:.8f} s".format(*main()))
