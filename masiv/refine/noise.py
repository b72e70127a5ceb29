"""Below what size a residual says nothing: how well the motion is known, and how well it is simulated."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.refine.model import Model
from masiv.refine.simulated import Simulated


def noise_floor(positions: np.ndarray, last_frame: int) -> float:
    """Root mean square distance [m] of observed positions (T, N, 3) [m] from the best rigid motion of each frame
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
    return float(np.sqrt(np.mean(squares)))


def uncertainty(simulation: Simulated, model: Model, values: dict[str, float], index: int) -> np.ndarray:
    """Root mean square distance (K,) [m] by which model and observation of experiment ``index`` may differ at each
    instant with nothing missing: noise, and what a finer grid changes. In free flight that is the noise alone.

    Not less than before as time goes on, since errors of the simulation grow. Raises NonFiniteError.
    """
    experiment = simulation.experiments[index]
    change = simulation.finer_grid(model, values, index)
    grid = np.zeros(experiment.instants) if change is None else np.sqrt((change**2).sum(2).mean(1))
    return np.hypot(experiment.noise, np.maximum.accumulate(grid))
