"""Where derivatives at no strength mislead: out of phase, and effects that fall short of their promise. Closed form."""

from __future__ import annotations

import numpy as np
import pytest

from masiv.inference.model_fit import gauss_newton_fit
from masiv.inference.robust import soft_l1_mean_square
from masiv.models.base import EffectTerm, ForwardModel, Model
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation
from masiv.refinement.candidates import score
from masiv.refinement.effect_fit import fit_with_effect

TIMES = np.linspace(0, 0.6, 60)
BARE, LOAD = 7.7, 2.2
"""Frequency [Hz]; load in effective masses of the bar."""
AXES = np.eye(3)


class Swing(ForwardModel):
    """Two markers on a bar that swings about its sag; ``mass`` at ``place`` (0: the clamp, 1: the tip) slows it and
    adds to the sag, ``push`` (two components) only moves it."""

    def __init__(self, out_of_phase):
        self.out_of_phase = out_of_phase
        self.observed = self.motion({"mass.mass": LOAD, "mass.place": 1.0})
        observation = Observation(
            name="a", times=TIMES, points=np.zeros((2, 3)), values=self.observed, fit_count=len(TIMES), noise_std=1e-5,
            residual_std=np.full(len(TIMES), 1e-5),
        )  # fmt: skip
        super().__init__([observation])

    def motion(self, values):
        load, place = values.get("mass.mass", 0.0), values.get("mass.place", 1.0)
        swing = BARE / np.sqrt(1 + load * place**4)
        sag = 0.005 * (1 + load * place**2)
        down = -sag * (1 - np.cos(2 * np.pi * swing * TIMES))
        out = np.stack([np.outer(down, AXES[1]), np.outer(0.8 * down, AXES[1])], axis=1)
        for k, axis in enumerate("xy"):
            out[:, :, k] += 1e-3 * values.get(f"push.{axis}", 0.0)
        return out

    def parameters(self, model):
        return tuple(p for name in model.effects for p in self.term(name).parameters)

    def term(self, name):
        if name == "push":
            own = tuple(Parameter(f"push.{axis}", 0.0, -100.0, 100.0, 0.1) for axis in "xy")
            return EffectTerm(name, name, own, (), ((),), {})
        own = Parameter("mass.mass", 0.0, 0.0, 100.0, 0.05), Parameter("mass.place", 0.5, 0.0, 1.0, 0.02)
        return EffectTerm(name, name, own[:1], own[1:], ((0.15,), (0.5,), (0.9,), (1.0,)), {})

    def candidates(self, model):
        return ["mass", "push"]

    def fields(self, model, values, *, held_out=False):
        return [self.motion(values) - self.observed]

    def is_out_of_phase(self, fields):
        return self.out_of_phase


def base_of(simulation):
    return gauss_newton_fit(simulation, Model(None, "none"), {}, budget=4, robust_scale=1.0)


def test_out_of_phase_a_cause_is_ranked_by_what_it_does_at_finite_strength():
    simulation = Swing(out_of_phase=True)
    base = base_of(simulation)
    assert base.parameters == ()  # nothing to fit is a fit, too
    first, second = score(simulation, base, ["mass", "push"], robust_scale=1.0).candidates
    assert (first.effect, second.effect) == ("mass", "push")
    tried = {**base.values, **first.theta}
    assert 1 - first.explained == pytest.approx(soft_l1_mean_square(simulation.residual(None, tried), 1.0) / base.cost)
    assert 1.0 in {c.theta["mass.place"] for c in (first, *first.alternatives)}
    fitted = fit_with_effect(simulation, base, first, 1.0)
    assert fitted.values["mass.place"] == 1.0
    assert fitted.values["mass.mass"] == pytest.approx(LOAD, rel=0.02)
    assert fitted.fit_mm < 0.05 * base.fit_mm
    # From none, on the derivative there, it is not found.
    linear = Swing(out_of_phase=False)
    about_none = next(c for c in score(linear, base, ["mass"], robust_scale=1.0).candidates if c.effect == "mass")
    assert fit_with_effect(linear, base, about_none, 1.0).fit_mm > 4 * fitted.fit_mm
    assert fit_with_effect(simulation, base, second, 1.0).fit_mm > 4 * fitted.fit_mm


class Saturating(Swing):
    """At place 0 the cause promises all and gives a fifth; at place 1 it promises less, and gives that."""

    def motion(self, values):
        load, place = values.get("mass.mass", 0.0), values.get("mass.place", 1.0)
        shape = np.outer(np.sin(9 * TIMES), AXES[1])
        other = np.outer(np.cos(9 * TIMES) - np.cos(9 * TIMES).mean(), AXES[0])
        moved = 0.2 * np.tanh(load / 0.2) * shape if place < 0.5 else load * (shape + 0.2 * other)
        return 1e-3 * np.stack([moved, moved], axis=1)

    def __init__(self):
        super().__init__(out_of_phase=False)
        self.observed = np.stack([1e-3 * np.outer(np.sin(9 * TIMES), AXES[1])] * 2, axis=1)

    def term(self, name):
        own = Parameter("mass.mass", 0.0, 0.0, 100.0, 0.01), Parameter("mass.place", 0.5, 0.0, 1.0, 1e-3)
        return EffectTerm(name, name, own[:1], own[1:], ((0.0,), (1.0,)), {})


def test_a_cause_that_falls_short_of_its_promise_is_begun_elsewhere():
    simulation = Saturating()
    base = base_of(simulation)
    (found,) = score(simulation, base, ["mass"], robust_scale=1.0).candidates
    assert found.theta["mass.place"] == 0.0
    assert [c.theta["mass.place"] for c in found.alternatives] == [1.0]
    fitted = fit_with_effect(simulation, base, found, 1.0)
    assert fitted.values["mass.place"] == pytest.approx(1.0)
    assert fitted.cost < 0.1 * base.cost


@pytest.mark.parametrize("out_of_phase", [False, True])
def test_what_the_base_left_at_a_guess_stays_there_beside_a_further_cause(out_of_phase):
    simulation = Swing(out_of_phase)
    simulation.observed = simulation.motion({"mass.mass": LOAD, "mass.place": 1.0, "push.x": 3.0})
    model = Model(None, "none", ("mass",))
    held = frozenset({"mass.place"})
    base = gauss_newton_fit(
        simulation, model, {"mass.mass": LOAD, "mass.place": 1.0}, budget=8, robust_scale=1.0, held=held
    )
    (push,) = score(simulation, base, ["push"], robust_scale=1.0).candidates
    fitted = fit_with_effect(simulation, base, push, 1.0)
    assert fitted.values["mass.place"] == 1.0
    assert {p.name for p in fitted.parameters} == {"mass.mass", "push.x", "push.y"}
    assert fitted.values["push.x"] == pytest.approx(3.0, rel=0.05)
    assert fitted.fit_mm < 0.05 * base.fit_mm
