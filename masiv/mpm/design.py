"""Grid spacing and substep from the object and its law."""

from __future__ import annotations

import math

from masiv.errors import MasivError
from masiv.mpm.config import SimulatorConfig

STIFFENING = 2.0
"""A law stiffens as it is compressed: the substep is for this multiple of its modulus at rest."""


def grid_spacing(volume: float, particle_count: int, config: SimulatorConfig) -> float:
    """Cell size [m] at which ``particle_count`` particles fill ``volume`` [m^3] with ``particles_per_cell`` each."""
    return (config.particles_per_cell * volume / particle_count) ** (1 / 3)


def substeps_per_frame(
    *, spacing: float, wave_modulus: float, density: float, speed: float, frame_time: float, config: SimulatorConfig
) -> int:
    """Substeps in a frame such that sound and matter at ``speed`` [m/s] together cross at most ``courant_number`` cells
    in each. Sound is sqrt(STIFFENING wave_modulus / density), wave_modulus [Pa] that of the law at rest. Raises
    MasivError if that is more than the configuration allows."""
    crossing = math.sqrt(STIFFENING * max(wave_modulus, 0.0) / density) + speed
    count = max(1, math.ceil(frame_time * crossing / (config.courant_number * spacing)))
    if count > config.max_substeps_per_frame:
        raise MasivError(
            f"the law (wave modulus {wave_modulus:.3g} Pa) needs {count} substeps a frame, more than "
            f"simulator.max_substeps_per_frame = {config.max_substeps_per_frame}: raise it, or use fewer particles"
        )
    return count
