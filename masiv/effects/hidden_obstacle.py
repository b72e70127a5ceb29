"""An obstacle that the cameras do not see."""

import numpy as np
import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.places import PLACE, as_guesses, farthest_points
from masiv.effects.search_hints import SearchHints
from masiv.rigid import impact_point

GUESSES = 11
RADIUS = EffectParameter("radius", "m", 0.0, 1.0, 0.05)


@ti.func
def _stopped(x, v, t, dt, dx, c):
    arm = x - ti.Vector([c[1], c[2], c[3]])
    distance = ti.sqrt(arm.dot(arm) + 1e-12)
    depth = ti.min(ti.max((c[0] - distance) / (0.5 * dx), 0.0), 1.0)
    inward = ti.min(v.dot(arm) / distance, 0.0)
    return v - (depth * depth * (3.0 - 2.0 * depth) * inward / distance) * arm


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """The place of the first impact above the ground, and places along the path, far apart, where the body was not at
    frame 0."""
    rest = context.rest
    if context.path is not None:
        swept = context.path[1:].reshape(-1, 3).to(rest)
    else:  # it falls
        shares = torch.linspace(0, 1, 6, dtype=rest.dtype)[1:, None]
        drop = torch.zeros(5, 3, dtype=rest.dtype)
        drop[:, 1:2] = shares * rest[:, 1].min().clamp(min=0.25 * context.size)
        swept = (rest[:: max(1, len(rest) // 500)] - drop[:, None]).reshape(-1, 3)
    swept = swept[:: max(1, len(swept) // 4000)]
    sparse = rest[:: max(1, len(rest) // 1000)]
    clear = torch.cdist(swept, sparse).amin(1) > RADIUS.step
    places = [farthest_points(swept[clear], GUESSES)] if clear.any() else []
    return as_guesses(torch.cat([*_first_impact(context, RADIUS.step), *places])) if places else []


def _first_impact(context: EffectContext, min_height: float) -> list[torch.Tensor]:
    """The place (1, 3) [m] of the first impact of the path, if it is higher than ``min_height`` [m]."""
    if context.path is None:
        return []
    path = context.path.double().numpy()
    place = impact_point(path, np.arange(len(path)) * context.frame_time, context.gravity.double().numpy())
    return [torch.as_tensor(place[None]).to(context.rest)] if place is not None and place[1] > min_height else []


class HiddenObstacle(NodalEffect):
    r"""A fixed, smooth sphere of radius $r$ about $x_0$: $v \leftarrow v - s(d)\,\min(v \cdot n, 0)\,n$ with
    $n = (x - x_0) / |x - x_0|$ and $s$ a smooth step from 0 at the surface to 1 at a depth of half a cell. Matter may
    slide off.

    A sphere smaller than a cell meets no node, so the response is not linear in the radius: a score needs a change as
    large as ``step``, the smallest sphere that a grid of the usual spacing resolves.
    """

    name = "hidden_obstacle"
    looks_like = "a part of the body stops, bends or turns aside in mid-air, always at the same place"
    parameters = (RADIUS, *PLACE)
    hints = SearchHints(guesses=_guesses)

    def node_velocity(self):
        return _stopped
