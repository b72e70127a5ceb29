"""Fits of few instants with given errors: what evidence and selection decide on, without a forward model."""

from __future__ import annotations

import math

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import NoiseModel
from masiv.models.base import EffectTerm, Model
from masiv.models.families import Family
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

INSTANTS, FITTED, COUNT = 6, 4, 5
NOISE, SAMPLES = 1e-3, 100
RATE = Parameter("linear_drag.rate", 0.1, 0.0, 10.0, 0.1)
DRAG = EffectTerm("linear_drag", "linear_drag", (RATE,), (), ((),), {RATE.name: "1/s"})


def noise_model(residual_std=NOISE, holds_out=True):
    """Of one observation of too few points to tell how smooth a noise is."""
    observation = Observation(
        name="a", times=np.arange(1.0, INSTANTS + 1), points=np.zeros((COUNT, 3)),
        values=np.zeros((INSTANTS, COUNT, 3)), fit_count=FITTED if holds_out else INSTANTS, noise_std=NOISE,
        residual_std=np.full(INSTANTS, residual_std),
    )  # fmt: skip
    return NoiseModel([observation])


def fit_with(fitted, held_out, *, count=3, gain=None, effects=(), z=5.0, law="neo_hookean"):
    """A fit whose mean squares are ``fitted`` and ``held_out`` times those of the noise, of ``count`` parameters. Its
    information criterion is by ``gain`` below that of a fit of cost 1 and as many parameters, or else as its cost says;
    a drag rate of 1 is ``z`` standard errors from zero."""
    squares = NOISE**2 * np.repeat([float(fitted), float(held_out)], [FITTED, INSTANTS - FITTED])
    field = np.sqrt(squares / 3)[:, None, None] * np.ones((INSTANTS, COUNT, 3))
    cost = fitted if gain is None else math.exp(-gain / SAMPLES)
    others = tuple(Parameter(f"p{k}", 0.0, -1.0, 1.0, 0.1) for k in range(count - 1))
    parameters = (RATE, *others)
    values = {p.name: 1.0 if p is RATE else 0.0 for p in parameters}
    residual = field[:FITTED].ravel()
    jacobian = np.linalg.qr(np.random.default_rng(0).normal(size=(len(residual), count)))[0]
    stderr = {p.name: 1.0 / z for p in parameters}
    model = Model(Family(law, (), {}), "none", tuple(effects))
    return ModelFit(model, values, parameters, residual, jacobian, cost, SAMPLES, 1.0, 1.0, [field], stderr)
