"""A forward model in closed form with known truth: points whose motion is linear in the strengths of effects.

It takes the place of a simulator where a search's decisions are tested: a rollout costs microseconds, and what is there
to be found is known.
"""

from __future__ import annotations

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import gauss_newton_fit
from masiv.models.base import EffectTerm, ForwardModel, Model
from masiv.models.families import Family
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

INSTANTS, FITTED, COUNT = 40, 30, 30
TIMES = np.linspace(0.0, 1.0, INSTANTS)
POINTS = np.random.default_rng(7).uniform(-0.2, 0.2, (COUNT, 3))
NOISE = 1e-3
"""Standard deviation [m] of a point's distance from where it is."""


def pattern(axis: int, in_time: np.ndarray, in_space: np.ndarray) -> np.ndarray:
    """(T, N, 3): ``in_time`` (T,) times ``in_space`` (N,) along ``axis``."""
    out = np.zeros((INSTANTS, COUNT, 3))
    out[:, :, axis] = in_time[:, None] * in_space[None]
    return out


ONES = np.ones(COUNT)
EFFECTS = {
    "linear_drag": pattern(0, TIMES**2, 1 + POINTS[:, 0]),
    "gravity_scale": pattern(1, np.sin(6 * TIMES), 1 + 2 * POINTS[:, 1]),
    "viscosity": pattern(2, np.cos(9 * TIMES) - 1, 1 + 3 * POINTS[:, 2]),
    "body_force": pattern(0, TIMES**2, 1 - POINTS[:, 0]),
}
"""Patterns (T, N, 3) [m] of unit strength. Names of the library, so that what is known of them holds."""


class LinearModel(ForwardModel):
    """A velocity along z, and effects that move the points by strength times pattern.

    truth: strengths that are there; exclusive: of two of these a model has one at most; diverges: effects that cannot
    be simulated. grid: strength of a pattern that finer grids change, twice as much on the second.
    """

    def __init__(self, truth, *, seed=0, exclusive=(), diverges=(), noise=NOISE, name="a", effects=EFFECTS):
        self.exclusive, self.diverges, self.effects = exclusive, diverges, dict(effects)
        random = np.random.default_rng(seed)
        values = POINTS + self.motion(truth) + random.normal(0.0, noise / np.sqrt(3), (INSTANTS, COUNT, 3))
        observation = Observation(
            name=name, times=TIMES, points=POINTS, values=values, fit_count=FITTED, noise_std=NOISE,
            residual_std=np.full(INSTANTS, NOISE),
        )  # fmt: skip
        super().__init__([observation])

    def motion(self, values):
        out = pattern(2, TIMES, values.get("velocity_z", 0.0) * ONES)
        for name, unit in self.effects.items():
            out = out + values.get(f"{name}.strength", 0.0) * unit
        return out

    def parameters(self, model):
        velocity = Parameter("velocity_z", 0.0, -3.0, 3.0, 0.01)
        return (velocity, *(p for n in model.effects for p in self.term(n).parameters))

    def term(self, name):
        strength = Parameter(f"{name}.strength", 0.0, -20.0, 20.0, 0.01)
        return EffectTerm(name, name, (strength,), (), ((),), {strength.name: "1"})

    def candidates(self, model):
        taken = any(n in self.exclusive for n in model.effects)
        return [n for n in self.effects if n not in model.effects and not (taken and n in self.exclusive)]

    def fields(self, model, values, *, held_out=False):
        if len({n for n in model.effects if n in self.exclusive}) > 1:
            raise AssertionError("a model with two effects of which one at most may act")
        if any(n in self.diverges and values[f"{n}.strength"] != 0.0 for n in model.effects):
            raise NonFiniteError(3, 4, "it flew apart")
        self.rollouts += 1
        stop = None if held_out else FITTED
        return [(POINTS + self.motion(values) - e.values)[:stop] for e in self.observations]


def baseline(forward_model, effects=()):
    """The model without effects, or with those that are known, fitted."""
    return gauss_newton_fit(forward_model, Model(Family("rigid", (), {}), "none", tuple(effects)), {}, budget=12)
