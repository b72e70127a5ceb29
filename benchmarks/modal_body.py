"""A clamped body whose modes of vibration are damped oscillators: a motion in closed form, with effects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from masiv.models.base import EffectTerm, ForwardModel, Model, effect_parameters
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

SIDES = np.array([0.3, 0.06, 0.08])
"""Of the body [m]; it is clamped at x = 0."""
FREQUENCIES = np.array([3.0, 4.5, 8.0, 15.0])
"""[Hz], without damping and at the expected stiffness: bending along y and z, torsion, stretching."""
YOUNGS_MODULUS = 1e5
"""[Pa], expected. A viscosity damps in proportion to stiffness: its rate is viscosity / modulus * (2 pi f)^2."""
PARTICIPATION = np.array([1.5, 1.5, 0.0, 1.3])
"""Acceleration of a mode's coordinate by a unit acceleration of the whole body along its axis."""
AXES = (1, 2, None, 0)
"""Along which an acceleration drives each mode."""
GRAVITY = np.array([0.0, -9.8, 0.0])
EFFECTS = ("linear_drag", "viscosity", "body_force", "gravity_scale")
RELEASED = tuple(f"release_{k}" for k in range(len(FREQUENCIES)))


def shapes(points: np.ndarray) -> np.ndarray:
    """Displacements (N, 3, modes) of ``points`` (N, 3) [m] by unit coordinates of the modes."""
    out = np.zeros((len(points), 3, len(FREQUENCIES)))
    along = points[:, 0] / SIDES[0]
    out[:, 1, 0] = out[:, 2, 1] = along**2
    out[:, 1, 2], out[:, 2, 2] = -along * points[:, 2] / SIDES[2], along * points[:, 1] / SIDES[2]
    out[:, 0, 3] = along
    return out


def oscillator(times: np.ndarray, start: np.ndarray, rate: np.ndarray, square: np.ndarray, force: np.ndarray):
    """Coordinates (T, M) [m] from rest at ``start`` (M,): q'' + rate q' + square q = force, each (M,)."""
    offset = start - force / square
    root = np.sqrt((square - rate**2 / 4).astype(complex))
    swing = np.cos(root * times[:, None]) + rate / 2 * np.sin(root * times[:, None]) / root
    return force / square + offset * (np.exp(-rate / 2 * times[:, None]) * swing).real


class ModalBody(ForwardModel):
    """Of one observation: release, stiffness and effects -> motion."""

    def __init__(self, observation: Observation) -> None:
        super().__init__([observation])
        self._shapes = shapes(observation.points)

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        release = [Parameter(name, 0.0, -0.2, 0.2, 1e-3) for name in RELEASED]
        stiffness = Parameter("log_stiffness", 0.0, -1.5, 1.5, 0.01)
        return (stiffness, *release, *(p for n in model.effects for p in self.term(n).parameters))

    def term(self, name: str) -> EffectTerm:
        own = effect_parameters(name)
        return EffectTerm(name, name, own, (), ((),), {p.name: "" for p in own})

    def candidates(self, model: Model) -> list[str]:
        return [n for n in EFFECTS if n not in model.effects]

    def motion(self, values: Mapping[str, float]) -> np.ndarray:
        """Places (T, N, 3) [m]."""
        e = self.observations[0]
        square = np.exp(values.get("log_stiffness", 0.0)) * (2 * np.pi * FREQUENCIES) ** 2
        rate = values.get("linear_drag.rate", 0.0) + values.get("viscosity.viscosity", 0.0) / YOUNGS_MODULUS * square
        push = np.array([values.get(f"body_force.acceleration_{a}", 0.0) for a in "xyz"])
        push = push + values.get("gravity_scale.relative_change", 0.0) * GRAVITY
        force = PARTICIPATION * [0.0 if axis is None else push[axis] for axis in AXES]
        start = np.array([values.get(name, 0.0) for name in RELEASED])
        return e.points + np.einsum("tm,nam->tna", oscillator(e.times, start, rate, square, force), self._shapes)

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        self.rollouts += 1
        return [self.observations[0].residual(self.motion(values))]
