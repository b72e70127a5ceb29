"""A twin in a situation that was never observed: another body, density or ground, fewer effects.

Effects stay. Their accelerations do not depend on the mass. Their places stay fixed in the world: in another body the
same place is another part of it, and over a lower ground they keep their height.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from masiv.bounds import DENSITY, LENGTH
from masiv.errors import InputError
from masiv.mpm.design import grid_spacing
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame
from masiv.twin import Twin, TwinEffect


def without_effects(twin: Twin, names: tuple[str, ...]) -> Twin:
    """``twin`` without the effects of these names. Raises InputError for one that it does not have."""
    present = [effect.name for effect in twin.effects]
    for name in names:
        if name not in present:
            raise InputError(f"--without {name}: the effects that act on this twin are {', '.join(present) or 'none'}")
    return replace(twin, effects=tuple(effect for effect in twin.effects if effect.name not in names))


def with_density(twin: Twin, density: float) -> Twin:
    """``twin`` with another density [kg/m^3]; its moduli stay. Raises InputError."""
    DENSITY.check(density, f"--density {density:g}")
    return twin.with_body(density=float(density))


def with_ground(twin: Twin, ground: str) -> Twin:
    """``twin`` over another ground: 'none', or a height [m] along the ground's normal (along up if it had no ground).

    The height is final: an effect that raises the ground is left out. Raises InputError for anything else, and for a
    ground that the body would intersect.
    """
    normal = _up(twin)
    before = 0.0 if twin.ground is None else twin.ground.height
    if ground.strip().lower() == "none":
        # The normal stays the vertical of the simulation frame, in which effects are given.
        changed = replace(twin, up=normal, effects=_over_new_ground(twin.effects, before))
        return changed.with_boundary(ground=None, contact="none")
    try:
        height = float(ground)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise InputError(f"--ground {ground[:40]}: give 'none' or a height in metres")
    LENGTH.check(abs(height), f"--ground {ground[:40]}")
    lowest = float((twin.positions.astype(np.float64) @ normal).min())
    if lowest < height - grid_spacing(twin.volume, len(twin.positions), twin.simulator):
        raise InputError(f"--ground {ground}: the body reaches down to {lowest:.3g} m, give a lower ground")
    contact = "sticky" if twin.contact == "none" else twin.contact
    effects = _over_new_ground(twin.effects, before - height)
    return replace(twin, effects=effects).with_boundary(ground=Ground(normal, height), contact=contact)


def with_body_of(twin: Twin, other: Twin) -> tuple[Twin, np.ndarray]:
    """``twin`` with the particles and the volume of ``other``, and the shift (3,) [m] that they were moved by.

    Sizes stay. The centre of the bounding box lies above or below the old one, the lowest point at the old height.
    """
    shift = _place(twin, other.positions.astype(np.float64))
    positions = (other.positions + shift).astype(np.float32)
    return twin.with_body(particles=positions, volume=other.volume), shift


def with_mesh(twin: Twin, mesh: Path) -> Twin:
    """``twin`` with a watertight mesh, y up, filled with about as many particles.

    A mesh file has no unit, so the mesh is scaled to the longest side of the body. It is placed as in ``with_body_of``.
    Raises InputError for a mesh that cannot be filled.
    """
    from masiv.shapes import ShapeSpec, make_body

    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    size = float(np.ptp(axes.points_to_simulation(twin.positions.astype(np.float64)), axis=0).max())
    spec = ShapeSpec.model_validate({"kind": "mesh", "mesh": mesh, "size": size})
    body = make_body(spec, len(twin.positions))
    if len(body.particles) < 8:
        raise InputError(f"{mesh} is too thin to be filled with about {len(twin.positions)} particles")
    particles = axes.points_to_world(body.particles)
    particles = particles + _place(twin, particles)
    return twin.with_body(particles=particles.astype(np.float32), volume=float(body.volume))


def _up(twin: Twin) -> np.ndarray:
    normal = np.asarray(twin.up if twin.ground is None else twin.ground.normal, dtype=np.float64)
    return normal / np.linalg.norm(normal)


def _over_new_ground(effects: tuple[TwinEffect, ...], lift: float) -> tuple[TwinEffect, ...]:
    """``effects`` over a ground that is lower by ``lift`` [m]: places (parameters x, y, z [m]) keep their height."""
    from masiv.effects.catalogue import effect_named
    from masiv.effects.effect import GeometryEffect

    kept = (e for e in effects if not isinstance(effect_named(e.name), GeometryEffect))
    return tuple(replace(e, values={**e.values, "y": e.values["y"] + lift}) if "y" in e.values else e for e in kept)


def _place(twin: Twin, positions: np.ndarray) -> np.ndarray:
    """The shift (3,) [m] that moves the bounding box of ``positions`` (N, 3) to that of the twin's body."""
    up = _up(twin)
    here = twin.positions.astype(np.float64)
    middle = 0.5 * (here.min(0) + here.max(0) - positions.min(0) - positions.max(0))
    lift = (here @ up).min() - (positions @ up).min()
    return middle - (middle @ up) * up + lift * up
