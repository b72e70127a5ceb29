"""The effects of a twin, ready for a rollout."""

from __future__ import annotations

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.effects.effect import Effect, GridEffect
from masiv.errors import InputError
from masiv.scene.transforms import SimulationFrame
from masiv.twin import Body, Twin


def extent(position: torch.Tensor) -> float:
    """Size [m] of a body of particles (N, 3): twice the 90 % quantile of their distances from the centroid."""
    return float((position - position.mean(0)).norm(dim=1).quantile(0.9)) * 2


def effect_members(
    twin: Twin, body: Body, dtype: torch.dtype = torch.float32
) -> tuple[tuple[Effect, torch.Tensor], ...]:
    """The effects of ``twin`` that act on ``body``, with their parameters (P,) for it. Raises InputError for an effect
    whose parameters are those of a medium if the body's drag properties are not known."""
    members = []
    for effect in twin.effects:
        if not effect.acts_on(body.name):
            continue
        known = effect_named(effect.name)
        theta = torch.tensor([effect.values[p.name] for p in effect.parameters], dtype=dtype)
        if effect.shared and known.per_body is not None:
            if body.drag is None:
                raise InputError(f"effect {effect.name}: the diameter and the medium of body {body.name} are not known")
            theta = known.per_body.of_body(theta, body.drag)
        members.append((known, theta))
    return tuple(members)


def active_effects(twin: Twin, *, frames: int, fps: float) -> ActiveEffects | None:
    """What acts on the only body of ``twin`` in addition to its law, gravity and the ground; None if nothing does.

    Places are in the twin's simulation frame. Raises InputError for two effects that both replace the contact.
    """
    if not twin.effects:
        return None
    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    rest = torch.as_tensor(axes.points_to_simulation(twin.positions), dtype=torch.float32)
    gravity = axes.vectors_to_simulation(np.asarray(twin.gravity, dtype=np.float64))
    context = EffectContext(
        gravity=torch.as_tensor(gravity, dtype=torch.float32),
        rest=rest,
        particle_mass=twin.density * twin.volume / len(rest),
        size=extent(rest),
        duration=max(frames - 1, 1) / fps,
        frame_time=1 / fps,
    )
    return ActiveEffects(effect_members(twin, twin.body), context)


def shift_effects(effects: ActiveEffects, by: torch.Tensor) -> ActiveEffects:
    """``effects`` for a rollout in which the body is lowered ``by`` () [m] in place of raising the ground.

    Places on the grid are lowered, too. Those of effects on particles are in the body at rest, ``EffectContext.rest``,
    which is not.
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
