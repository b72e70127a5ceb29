"""Points that do not touch each other, moved by a force field in closed form: a search of what pushes them."""

from __future__ import annotations

import numpy as np
import torch
from linear_model import EFFECTS, POINTS, TIMES, LinearModel
from scipy.integrate import cumulative_trapezoid

from masiv.effects.context import EffectContext
from masiv.effects.smooth_force import acceleration
from masiv.models.base import plain_term
from masiv.refinement.discrepancy import DISCREPANCY_FORCE
from masiv.scene.transforms import SimulationFrame

FINE = 10
"""Steps of the integration between two instants."""


class PushedPoints(LinearModel):
    """``LinearModel`` whose points a ``push`` (t (T,), x (T, N, 3)) -> (T, N, 3) [m/s^2] accelerates from rest. Forces
    are taken at the places where the points start. axes: those of the effects."""

    def __init__(self, push, axes=None, **kind):
        self.push = push
        self.axes = axes or SimulationFrame(np.eye(3), np.zeros(3))
        super().__init__(None, effects={"viscosity": EFFECTS["viscosity"]}, **kind)

    def effect_axes(self, index):
        return self.axes

    def motion(self, values):
        if values is None:  # the truth
            return way(self.push)
        own = [v for n, v in values.items() if n.startswith(f"{DISCREPANCY_FORCE}.")]
        rest = super().motion({n: v for n, v in values.items() if not n.startswith(f"{DISCREPANCY_FORCE}.")})
        return rest + way(lambda t, x: self.force(np.array(own), t, x)) if own else rest

    def force(self, theta, times, places):
        return self.axes.vectors_to_world(acceleration(theta, self.axes.points_to_simulation(places), times))

    def term(self, name):
        if name != DISCREPANCY_FORCE:
            return super().term(name)
        rest = torch.as_tensor(self.axes.points_to_simulation(POINTS))
        return plain_term(name, EffectContext(torch.zeros(3), rest, 1.0, 0.4, float(TIMES[-1])))


def way(push):
    """(T, N, 3) [m] from rest, at ``TIMES``."""
    fine = np.linspace(0.0, TIMES[-1], FINE * (len(TIMES) - 1) + 1)
    at = push(fine, np.broadcast_to(POINTS, (len(fine), *POINTS.shape)))
    velocity = cumulative_trapezoid(at, fine, axis=0, initial=0)
    return cumulative_trapezoid(velocity, fine, axis=0, initial=0)[::FINE]
