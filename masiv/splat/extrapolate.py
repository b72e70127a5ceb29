"""First estimate of the motion at a frame that is added to a fit: constant velocity."""

from __future__ import annotations

import numpy as np
import torch

from masiv.splat.deformation import DeformationNetwork

_STEPS = 60
_POINTS = 400


def extrapolate_motion(
    network: DeformationNetwork, means: torch.Tensor, frame: int, rate: float, rng: np.random.Generator
) -> None:
    """Fit ``network`` so that at ``frame`` points continue the motion of the two frames before; earlier ones are kept.

    The displacement relative to the base motion continues at constant velocity. means (N, 3) [m] at frame 0; rate: of
    Adam. Nothing changes before frame 2.
    """
    if frame < 2:
        return
    times = torch.arange(frame + 1) / network.fps
    points = means[torch.from_numpy(rng.permutation(len(means))[:_POINTS])]
    with torch.no_grad():
        base = network.base_displacements(times)
        target = network.displacements(points, times)
        relative = target - base[:, None]
        target[frame] = base[frame] + 2 * relative[frame - 1] - relative[frame - 2]
    weights = [p for name, p in network.named_parameters() if name != "base_motion"]
    optimiser = torch.optim.Adam(weights, lr=rate)
    extent = network.settings["half_extent"]
    for _ in range(_STEPS):
        chosen = np.append(rng.permutation(frame)[:3], frame)
        optimiser.zero_grad()
        loss = (network.displacements(points, times[chosen]) - target[chosen]).square().mean() / extent**2
        loss.backward()
        optimiser.step()
