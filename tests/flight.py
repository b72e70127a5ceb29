"""A cube that flies, tumbles and lands, with effects that may be at work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from small import NODES, SMALL, SUBSTEPS

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.identification.config import IdentifyConfig
from masiv.materials.classical import ClassicalLaw
from masiv.models.free_body import FreeBodyModel
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator
from masiv.observations.motion import SampledMotion
from masiv.refinement.config import RefineConfig
from masiv.refinement.prepare import prepare
from masiv.scene.scene import Ground, Scene

FPS, FRAMES, FITTED = 24.0, 14, 10
SIDE, COUNT = 0.3, 512
VELOCITY, OMEGA = (1.5, 0.5, 0.4), (1.0, 2.0, -3.0)


def no_pictures(view, frame):
    raise AssertionError("tracks have no pictures")


def scene():
    return Scene(path=Path("tracks"), layout="tracks", fps=FPS, frame_count=FRAMES, cameras=(),
                 gravity=np.array([0.0, -9.8, 0.0]), up=np.array([0.0, 1.0, 0.0]),
                 ground=Ground(np.array([0.0, 1.0, 0.0]), 0.0), density=1000.0, load=no_pictures,
                 mask_source="none")  # fmt: skip


def observed(effects, noise_m=3e-4, velocity=VELOCITY, omega=OMEGA):
    """The motion of a cube that is thrown and lands, with ``effects`` {name or effect: parameters} at work."""
    side = round(COUNT ** (1 / 3))
    axis = (torch.arange(side) + 0.5) / side * SIDE
    start = torch.cartesian_prod(axis, axis, axis) + torch.tensor([0.0, 0.45, 0.0])
    steps = 48
    simulator = Simulator(particle_count=COUNT, spacing=(6 * SIDE**3 / COUNT) ** (1 / 3), substep=1 / (FPS * steps),
                          volume=SIDE**3, density=1000.0, gravity=(0.0, -9.8, 0.0),
                          max_substeps=SUBSTEPS, grid_nodes=NODES)  # fmt: skip
    setting = EffectContext(torch.tensor([0.0, -9.8, 0.0]), start, 1000 * SIDE**3 / COUNT, SIDE, FRAMES / FPS)
    members = tuple(
        (effect_named(kind) if isinstance(kind, str) else kind, torch.tensor(values))
        for kind, values in effects.items()
    )
    law = ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3)
    outputs = [k * steps for k in range(1, FRAMES)]
    with torch.no_grad():
        state = rigid_initial_state(start, torch.tensor(velocity), torch.tensor(omega))
        effects = ActiveEffects(members, setting) if members else None
        path = rollout(simulator, law, state, outputs[-1], outputs, effects)
    positions = np.concatenate([start[None].numpy(), path.numpy()]).astype(np.float64)
    positions[1:] += np.random.default_rng(0).normal(0, noise_m, positions[1:].shape)
    return SampledMotion(positions, np.arange(FRAMES) / FPS, SIDE**3)


def small_simulation():
    """A model of few particles of a cube that drag slows down, and its configuration."""
    motion = observed({"linear_drag": [1.0]})
    first = SampledMotion(motion.positions[:FITTED], motion.times[:FITTED], motion.volume)
    config = RefineConfig(particles=200, samples_per_frame=1, laws=["neo_hookean"])
    contact = IdentifyConfig(contact="sticky")
    setup, *_ = prepare("run", scene(), first, motion, contact, SMALL, config)
    return FreeBodyModel([setup]), config
