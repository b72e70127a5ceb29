"""More particles for a prediction than for its fit, on the same grid.

A particle is a quadrature point of the body. If matter is stretched until neighbouring particles are more than about a
cell apart, no force acts across the grid nodes between them: the body tears, whatever its law (numerical fracture),
thin parts first. Four points in place of one delay that, at the cost of one rollout instead of a whole fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from masiv.errors import InputError
from masiv.twin import Twin

_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_TETRAHEDRON = _CUBE[_CUBE.prod(axis=1) > 0]
PATTERNS = {1: np.zeros((1, 3)), 4: _TETRAHEDRON, 8: _CUBE}
"""Places of the parts of a particle, in quarters of the particle spacing; their mean is the particle."""


def subdivide_particles(positions: np.ndarray, spacing: float, parts: int) -> np.ndarray:
    """Particles (Q, 3) [m] at rest, each of spacing³ -> (Q parts, 3) float32, the parts of one in a row."""
    offsets = 0.25 * spacing * PATTERNS[parts]
    return (np.asarray(positions, np.float64)[:, None] + offsets).reshape(-1, 3).astype(np.float32)


def merge_subparticles(positions: np.ndarray, count: int) -> np.ndarray:
    """Positions (T, count parts, 3) [m] of parts -> positions (T, count, 3) of the particles that they are parts of.

    Raises InputError if they cannot be parts of ``count`` particles.
    """
    if positions.shape[1] % count:
        raise InputError(f"{positions.shape[1]} simulated particles are not parts of {count}: simulate the twin again")
    return positions.reshape(len(positions), count, -1, 3).mean(axis=2)


def subdivide_twin(twin: Twin) -> Twin:
    """``twin`` with each particle of its only body in ``simulator.subparticles`` parts, on the grid that it had. A body
    of springs stays as it is: its springs are between its particles."""
    if twin.law.kind == "springs":
        return replace(twin, simulator=twin.simulator.model_copy(update={"subparticles": 1}))
    config, count = twin.simulator, len(twin.positions)
    spacing = (twin.volume / count) ** (1 / 3)
    simulator = config.model_copy(
        update={"particles_per_cell": config.subparticles * config.particles_per_cell, "subparticles": 1},
    )
    positions = subdivide_particles(twin.positions, spacing, config.subparticles)
    return replace(twin.with_body(particles=positions), simulator=simulator)
