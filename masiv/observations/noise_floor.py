"""Below what size a residual says nothing: how well the motion is known."""

from __future__ import annotations

import numpy as np

from masiv.rigid import beyond_rigid, beyond_uniform

UNIFORM, USUAL = 2.5, 1.4
"""How many times farther than from the best affine map errors of the observation are from the best rigid motion, at
most and usually (1.0 to 2.5 in flights of eleven scenes followed in pictures, 1.2 to 2.2 in simulated noise)."""


def noise_floor(positions: np.ndarray, last_frame: int) -> float:
    """Root mean square distance [m] of observed positions (T, N, 3) [m] from the best rigid motion of each frame
    1…last_frame-1 of free flight.

    A body without internal motion stays rigid in free flight, also under drag or wind. So what is not rigid is the
    error of the observation. The exception is a uniform strain that is much larger than the rest: the body itself
    swells or vibrates. Rigid errors cannot be seen; errors that are smooth over the body are assumed to have as large a
    rigid part. If the body touches the ground at once, frame 1 is used.
    """
    flight = positions[: max(2, last_frame)]
    rigid, uniform = beyond_rigid(flight), beyond_uniform(flight)
    return float(np.sqrt(2 * np.mean(np.where(rigid > UNIFORM * uniform, USUAL * uniform, rigid) ** 2)))
