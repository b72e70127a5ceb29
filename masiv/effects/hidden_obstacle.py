"""Something in the way that the cameras do not see."""

import numpy as np
import taichi as ti
import torch

from masiv.effects._place import PLACE, as_guesses, spread
from masiv.effects.effect import Effect, EffectContext, EffectParameter
from masiv.rigid import impact_point

_GUESSES = 11


@ti.func
def _stopped(x, v, held, t, dt, dx, c):
    arm = x - ti.Vector([c[1], c[2], c[3]])
    distance = ti.sqrt(arm.dot(arm) + 1e-12)
    depth = ti.min(ti.max((c[0] - distance) / (0.5 * dx), 0.0), 1.0)
    inward = ti.min(v.dot(arm) / distance, 0.0)
    return v - (depth * depth * (3.0 - 2.0 * depth) * inward / distance) * arm


class HiddenObstacle(Effect):
    """A fixed, smooth sphere: velocity into it is taken away, over half a cell of depth. Matter may slide off.

    Its effect is not of first order in the radius (a sphere smaller than a cell meets no node): a score needs a change
    as large as ``step``, the smallest sphere that a grid of the usual spacing resolves.
    """

    name = "hidden_obstacle"
    looks_like = "a part of the body stops, bends or turns aside in mid-air, always at the same place"
    parameters = (EffectParameter("radius", "m", 0.0, 1.0, 0.05), *PLACE)
    on_grid = "nodes"

    def node_velocity(self):
        return _stopped

    def guesses(self, setting):
        """Where the body is first turned aside above the ground, and places far apart that it reaches, or all but
        reaches, and where it was not at frame 0."""
        rest = setting.rest
        if setting.path is not None:
            swept = setting.path[1:].reshape(-1, 3).to(rest)
        else:  # it falls
            shares = torch.linspace(0, 1, 6, dtype=rest.dtype)[1:, None]
            drop = torch.zeros(5, 3, dtype=rest.dtype)
            drop[:, 1:2] = shares * rest[:, 1].min().clamp(min=0.25 * setting.size)
            swept = (rest[:: max(1, len(rest) // 500)] - drop[:, None]).reshape(-1, 3)
        swept = swept[:: max(1, len(swept) // 4000)]
        sparse = rest[:: max(1, len(rest) // 1000)]
        clear = torch.cdist(swept, sparse).amin(1) > self.parameters[0].step
        places = [spread(swept[clear], _GUESSES)] if clear.any() else []
        return as_guesses(torch.cat([*_struck(setting, self.parameters[0].step), *places])) if places else []


def _struck(setting: EffectContext, least_height: float) -> list[torch.Tensor]:
    """The place (1, 3) [m] where the body is first turned aside, if that is higher than ``least_height`` [m]."""
    if setting.path is None:
        return []
    path = setting.path.double().numpy()
    place = impact_point(path, np.arange(len(path)) * setting.frame_time, setting.gravity.double().numpy())
    return [torch.as_tensor(place[None]).to(setting.rest)] if place is not None and place[1] > least_height else []
