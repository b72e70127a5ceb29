"""A small body above the ground that effects are tried on."""

from __future__ import annotations

import torch
from small import NODES, SUBSTEPS

from masiv.effects.context import EffectContext
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.simulator import Simulator

F64 = torch.float64
DT, STEPS = 1e-3, 40
LAW = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)


def body(count=200, height=0.02):
    generator = torch.Generator().manual_seed(1)
    x = 0.2 * torch.rand(count, 3, generator=generator, dtype=F64)
    x[:, 1] += height
    return x


def setting(x):
    return EffectContext(torch.tensor([0.0, -9.8, 0.0], dtype=x.dtype), x, 1e3 * 0.2**3 / len(x), 0.2, STEPS * DT)


def simulator(count, contact="sticky", gravity=(0, -9.8, 0), friction=0.3, dtype=F64):
    return Simulator(particle_count=count, spacing=0.05, substep=DT, volume=0.2**3, density=1e3, gravity=gravity,
                     contact=contact, friction=friction, dtype=dtype, max_substeps=SUBSTEPS,
                     grid_nodes=NODES)  # fmt: skip
