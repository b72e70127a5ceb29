"""A force round a vertical axis."""

import taichi as ti
import torch

from masiv.effects.effect import Effect, EffectParameter

UNIFORM = 0.9
"""Share of a swirl's mean square, over where the body was, from which it is no more than a uniform force."""


@ti.func
def _swirled(x, v, held, t, dt, dx, c):
    return v + (dt * c[0]) * ti.Vector([x[2] - c[2], 0.0, c[1] - x[0]])


class Swirl(Effect):
    """dv/dt = theta up x (x - c), up = (0, 1, 0): spins the body up at theta rad/s^2 and carries it round the axis."""

    name = "swirl"
    looks_like = "the body turns about the vertical faster and faster, or slower and slower, and is carried round"
    parameters = (
        EffectParameter("strength", "1/s^2", -100.0, 100.0, 0.05),
        EffectParameter("x", "m", -100.0, 100.0, 0.02),
        EffectParameter("z", "m", -100.0, 100.0, 0.02),
    )
    on_grid = "nodes"

    def node_velocity(self):
        return _swirled

    def identifiability_issue(self, theta, watched, places):
        """About an axis that is far from where the body was, it pushes all of it the same way."""
        arms = places[:, ::2].double() - theta[1:].double()
        middle = arms.mean(0)
        if float(middle.square().sum()) < UNIFORM * float(arms.square().sum(1).mean()):
            return None
        return f"its axis is {float(torch.linalg.vector_norm(middle)):.2g} m away, where it is but a uniform force"

    def guesses(self, setting):
        """Through the body, and a body's size away from it on four sides."""
        x, _, z = setting.rest.double().mean(0).tolist()
        d = setting.size
        return [(x, z), (x + d, z), (x - d, z), (x, z + d), (x, z - d)]
