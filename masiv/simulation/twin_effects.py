"""The effects of a twin, ready for a rollout."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.effects.effect import GridEffect
from masiv.scene.transforms import SimulationFrame

if TYPE_CHECKING:
    from masiv.twin import Twin


def extent(position: torch.Tensor) -> float:
    """Size [m] of a body of particles (N, 3): twice the distance from their middle that nine tenths keep."""
    return float((position - position.mean(0)).norm(dim=1).quantile(0.9)) * 2


def active_effects(twin: Twin, *, frames: int, fps: float, gravity: np.ndarray | None = None) -> ActiveEffects | None:
    """What acts on ``twin`` besides its law, gravity (3,) [m/s^2, world] (the twin's where None) and ground.

    None where nothing does. Places are in the twin's simulation frame. Raises InputError for two effects that both
    replace the contact.
    """
    if not twin.effects:
        return None
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    rest = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    pull = axes.vectors_to_simulation(np.asarray(twin.gravity if gravity is None else gravity, dtype=np.float64))
    setting = EffectContext(
        gravity=torch.as_tensor(pull, dtype=torch.float32),
        rest=rest,
        particle_mass=twin.density * twin.volume / len(rest),
        size=extent(rest),
        duration=max(frames - 1, 1) / fps,
        frame_time=1 / fps,
    )
    members = []
    for effect in twin.effects:
        known = effect_named(effect.name)
        members.append((known, torch.tensor([effect.values[p.name] for p in known.parameters], dtype=torch.float32)))
    return ActiveEffects(tuple(members), setting)


def lowered(effects: ActiveEffects, by: torch.Tensor) -> ActiveEffects:
    """``effects`` for a rollout whose ground is raised by lowering the body ``by`` () [m]: places on the grid too.

    Those of effects on particles are in the body at rest, ``EffectContext.rest``, which is not lowered.
    """
    members = []
    for effect, theta in effects.members:
        names = [p.name for p in effect.parameters]
        if isinstance(effect, GridEffect) and "y" in names:
            height = torch.zeros_like(theta)
            height[names.index("y")] = 1.0
            theta = theta - height * by
        members.append((effect, theta))
    return ActiveEffects(tuple(members), effects.context)


def mass_ratio(effects: ActiveEffects | None) -> float:
    """Mass of the body with what effects add to it, over its own."""
    factor = None if effects is None else effects.mass_factor()
    return 1.0 if factor is None else float(factor.double().mean())


def body_mass(twin: Twin) -> float:
    """Mass [kg] of the twin's body with what effects add to it."""
    return float(twin.density * twin.volume) * mass_ratio(active_effects(twin, frames=1, fps=twin.fps))
