"""Prints a hash of a rollout, a picture and their gradients: run by test_threads.py in processes of their own."""

from __future__ import annotations

import hashlib

import torch
from random_gaussians import BACKGROUND, make_camera, make_gaussians, weighted
from small import NODES, SUBSTEPS

from masiv import runtime
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.taped_rollout import SERIAL_PARTICLES
from masiv.splat.rasteriser import render

COUNT, STEPS = SERIAL_PARTICLES + 200, 24


def simulated() -> list[torch.Tensor]:
    """Positions of a body that meets the ground, and gradients; more particles than one thread is left alone with."""
    generator = torch.Generator().manual_seed(1)
    x = (0.5 * torch.rand(COUNT, 3, generator=generator)).requires_grad_()
    v = torch.randn(COUNT, 3, generator=generator) - torch.tensor([0.0, 2.0, 0.0])
    simulator = Simulator(
        particle_count=COUNT, spacing=0.05, substep=1e-3, volume=0.125, density=1000.0, gravity=(0.0, -9.8, 0.0),
        max_substeps=SUBSTEPS, grid_nodes=NODES,
    )  # fmt: skip
    law = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)
    end = rollout(simulator, law, at_rest(x, v, torch.zeros(COUNT, 3, 3)), STEPS, [STEPS])
    return [end.detach(), *torch.autograd.grad(end.square().sum(), [x, *law.parameters()])]


def drawn() -> list[torch.Tensor]:
    """A picture and its gradients."""
    gaussians = make_gaussians(500, seed=9, dtype=torch.float32)
    picture = render(make_camera(80, 70), *gaussians, BACKGROUND.float())
    return [picture.rgb.detach(), *torch.autograd.grad(weighted(picture), gaussians)]


if __name__ == "__main__":
    runtime.start("cpu")
    digest = hashlib.sha256()
    for tensor in (*simulated(), *drawn()):
        assert tensor.isfinite().all()
        digest.update(tensor.contiguous().numpy().tobytes())
    print(runtime.threads(), digest.hexdigest())
