"""How well the motion itself is known, from the motion alone."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def noise_floor_mm(positions: np.ndarray, last_frame: int) -> float:
    """Root mean square distance [mm] of observed positions (T, N, 3) [m] from the best rigid motion of each frame
    1…last_frame-1 of free flight.

    A body at rest within that is thrown stays rigid until it touches something, whatever drag or wind does to it: what
    is not rigid is the error of the observation. Rigid errors are not seen, so it is a lower bound. Where the body
    touches at once, frame 1 has to do.
    """
    start = positions[0] - positions[0].mean(0)
    squares = []
    for k in range(1, max(2, last_frame)):
        now = positions[k] - positions[k].mean(0)
        turn = Rotation.align_vectors(now, start)[0]
        squares.append(((now - turn.apply(start)) ** 2).sum(1).mean())
    return 1e3 * float(np.sqrt(np.mean(squares)))
