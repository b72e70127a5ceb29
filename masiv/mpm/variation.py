"""A twin changed into one that was never filmed: another body, density or ground."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.errors import InputError
from masiv.mpm.design import grid_spacing
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame

if TYPE_CHECKING:
    from masiv.twin import Twin


def with_density(twin: Twin, density: float) -> Twin:
    """``twin`` with another density [kg/m^3]; its moduli stay. Raises InputError."""
    if not (math.isfinite(density) and density > 0):
        raise InputError(f"--density {density:g}: give a density above 0 kg/m³")
    return replace(twin, density=float(density))


def with_ground(twin: Twin, ground: str) -> Twin:
    """``twin`` over another ground: 'none', or a height [m] along the ground's normal (up, where it had no ground).

    Raises InputError for anything else, and for a ground that the body would stand in.
    """
    if ground.strip().lower() == "none":
        return replace(twin, ground=None, contact="none")
    try:
        height = float(ground)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise InputError(f"--ground {ground}: give 'none' or a height in metres")
    normal = _up(twin)
    lowest = float((twin.positions.astype(np.float64) @ normal).min())
    if lowest < height - grid_spacing(twin.volume, len(twin.positions), twin.simulator):
        raise InputError(f"--ground {ground}: the body reaches down to {lowest:.3g} m, give a lower ground")
    return replace(twin, ground=Ground(normal, height), contact="sticky" if twin.contact == "none" else twin.contact)


def with_body_of(twin: Twin, other: Twin) -> tuple[Twin, np.ndarray]:
    """``twin`` with the particles and the volume of ``other``, and the shift (3,) [m] that put them in its place.

    Sizes stay; the boxes' middles are one above the other and their lowest points at one height.
    """
    shift = _place(twin, other.positions.astype(np.float64))
    positions = (other.positions + shift).astype(np.float32)
    return replace(twin, positions=positions, volume=other.volume), shift


def with_mesh(twin: Twin, mesh: Path) -> Twin:
    """``twin`` with a watertight mesh filled with about as many particles, y of the mesh up.

    A mesh says nothing of its unit, so its longest side is made the body's own; it takes the body's place as in
    ``with_body_of``. Raises InputError for a mesh that cannot be filled.
    """
    from masiv.synth.shapes import make_body
    from masiv.synth.spec import ShapeSpec

    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    size = float(np.ptp(axes.points_to_simulation(twin.positions.astype(np.float64)), axis=0).max())
    body = make_body(ShapeSpec(kind="mesh", mesh=mesh, size=size), len(twin.positions))
    if len(body.particles) < 8:
        raise InputError(f"{mesh} is too thin to be filled with about {len(twin.positions)} particles")
    particles = axes.points_to_world(body.particles)
    particles = particles + _place(twin, particles)
    return replace(twin, positions=particles.astype(np.float32), volume=float(body.volume))


def _up(twin: Twin) -> np.ndarray:
    normal = np.asarray(twin.up if twin.ground is None else twin.ground.normal, dtype=np.float64)
    return normal / np.linalg.norm(normal)


def _place(twin: Twin, positions: np.ndarray) -> np.ndarray:
    """The shift (3,) [m] that puts the box of ``positions`` (N, 3) where the twin's body stands."""
    up = _up(twin)
    here = twin.positions.astype(np.float64)
    middle = 0.5 * (here.min(0) + here.max(0) - positions.min(0) - positions.max(0))
    lift = (here @ up).min() - (positions @ up).min()
    return middle - (middle @ up) * up + lift * up
