"""A small body above the ground that effects are tried on."""

from __future__ import annotations

import torch
from small import NODES, SUBSTEPS

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.context import EffectContext
from masiv.materials.classical import ClassicalLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator

F64 = torch.float64
DT, STEPS = 1e-3, 40
WEIGHTLESS = (0.0, 0.0, 0.0)
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


def run(name, theta, steps, *, x=None, velocity=(0, 0, 0), omega=(0, 0, 0), outputs=None, law=LAW, state=None, **kind):
    """Positions (K, N, 3) at the substeps ``outputs``, the last two by default, of a body far above ground."""
    x = body(height=5.0) if x is None else x
    state = (
        rigid_initial_state(x, torch.tensor(velocity, dtype=F64), torch.tensor(omega, dtype=F64))
        if state is None
        else state
    )
    active = None
    if name is not None:
        active = ActiveEffects(((effects()[name], torch.tensor(theta, dtype=F64)),), setting(x))
    return rollout(simulator(len(x), **kind), law, state, steps, outputs or [steps - 1, steps], active)


def last_velocity(positions):
    """Mean (3,) over the particles in the last substep."""
    return ((positions[-1] - positions[-2]) / DT).mean(0).numpy()
