"""Below what size a residual says nothing: how well the motion is known, and how well it is simulated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from masiv.refine.refit import Fitted
from masiv.refine.simulated import Simulated
from masiv.rigid import beyond_rigid, beyond_uniform

UNIFORM, USUAL = 2.5, 1.4
"""How many times farther than from the best affine map errors of the observation are from the best rigid motion, at
most and usually (1.0 to 2.5 in flights of eleven scenes followed in pictures, 1.2 to 2.2 in simulated noise)."""


def noise_floor(positions: np.ndarray, last_frame: int) -> float:
    """Root mean square distance [m] of observed positions (T, N, 3) [m] from the best rigid motion of each frame
    1…last_frame-1 of free flight.

    A body at rest within that is thrown stays rigid until it touches something, whatever drag or wind does to it: what
    is not rigid is the error of the observation. Not so a strain that is the same everywhere and much larger than what
    else is not rigid: that is a body which swells or swings. Rigid errors are not seen; with errors that are smooth
    over the body they are taken to be as large again. Where the body touches at once, frame 1 has to do.
    """
    flight = positions[: max(2, last_frame)]
    rigid, uniform = beyond_rigid(flight), beyond_uniform(flight)
    return float(np.sqrt(2 * np.mean(np.where(rigid > UNIFORM * uniform, USUAL * uniform, rigid) ** 2)))


def uncertainties(simulation: Simulated, fitted: Fitted, observation: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For each experiment, the root mean square distance (K,) [m] by which model and observation may differ at each
    instant with nothing missing: that of the ``observation`` (K,), and what finer grids change and no fit could
    absorb, on average. In free flight that is nothing.

    Not less than before as time goes on, since errors of the simulation grow. Raises NonFiniteError.
    """
    found = [simulation.finer_grids(fitted.model, fitted.values, k) for k in range(len(simulation.experiments))]
    kept = [_not_absorbed(simulation, fitted, observation, changes) for changes in zip(*found, strict=True)]
    if not kept:
        return list(observation)
    grids = (np.sqrt(np.mean(np.square(each), axis=0)) for each in zip(*kept, strict=True))
    return [np.hypot(seen, np.maximum.accumulate(g)) for seen, g in zip(observation, grids, strict=True)]


def _not_absorbed(
    simulation: Simulated, fitted: Fitted, observation: Sequence[np.ndarray], changes: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """For each experiment, the root mean square (K,) [m] of what another grid ``changes`` (K, N, A) and no fit absorbs.

    A fit absorbs the change's part along the derivatives of ``fitted``; after the fitted instants, the same share as at
    the end of these is taken to be absorbed.
    """
    experiments = simulation.experiments
    whole = [np.sqrt((change**2).sum(2).mean(1)) for change in changes]
    weights = [
        e.noise / np.hypot(seen, np.maximum.accumulate(size))
        for size, seen, e in zip(whole, observation, experiments, strict=True)
    ]
    rows = [c[: e.rows] * w[: e.rows, None, None] for c, w, e in zip(changes, weights, experiments, strict=True)]
    counts = [part.size for part in rows]
    # The derivatives are weighted by the sigma so far.
    more = [(w * e.sigma / e.noise)[: e.rows] for w, e in zip(weights, experiments, strict=True)]
    each = np.concatenate([np.repeat(m, n // len(m)) for m, n in zip(more, counts, strict=True)])
    jacobian = fitted.jacobian * each[:, None]
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    flat = np.concatenate([part.ravel() for part in rows])
    left = flat - jacobian @ (np.linalg.lstsq(jacobian / scale, flat, rcond=1e-8)[0] / scale)
    out = []
    for part, size, weight, experiment, mine in zip(
        rows, whole, weights, experiments, np.split(left, np.cumsum(counts)[:-1]), strict=True
    ):
        kept = np.sqrt((mine.reshape(part.shape) ** 2).sum(2).mean(1)) / weight[: experiment.rows]
        share = min(float(kept[-1] / max(size[experiment.rows - 1], 1e-300)), 1.0)
        out.append(np.concatenate([np.minimum(kept, size[: experiment.rows]), share * size[experiment.rows :]]))
    return out
