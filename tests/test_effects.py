"""Every effect of the library: absent at zero strength, its gradient against finite differences."""

from __future__ import annotations

import sys

import pytest
import torch
from effect_cases import DT, F64, LAW, STEPS, body, setting, simulator

import masiv.effects
from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.effect import KINDS, ContactEffect, Effect, NodalEffect, SuspendedMassEffect
from masiv.errors import InputError
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout


def thrown_body(x):
    return rigid_initial_state(x, torch.tensor([0.6, -1.2, 0.3], dtype=F64), torch.tensor([2.0, 1.0, -3.0], dtype=F64))


def positions(theta, effect, x, contact="sticky"):
    """The last positions of the throw with the effect. Shifts of the ground and the clock are the caller's: here."""
    active = ActiveEffects(((effect, theta),), setting(x))
    zero = torch.zeros(1, dtype=F64)
    shift = torch.cat([zero, active.ground_shift().to(F64).reshape(1), zero])
    before, last = rollout(simulator(len(x), contact), LAW, thrown_body(x - shift), STEPS, [STEPS - 1, STEPS], active)
    return last + active.time_shift() * (last - before) / DT + shift


def present(effect):
    """Parameters of a clear case of the effect, at the guess that is nearest to the body's lower end."""
    x = body()
    guesses = effect.guesses(setting(x))
    strengths = [(8 + k) * p.step for k, p in enumerate(effect.parameters[: effect.strengths])]
    return torch.tensor([*strengths, *guesses[0]], dtype=F64)


@pytest.mark.parametrize("name", sorted(effects()))
def test_absent_at_zero_strength(name):
    effect, x = effects()[name], body()
    theta = present(effect)
    theta[: effect.strengths] = 0
    without = rollout(simulator(len(x)), LAW, thrown_body(x), STEPS, [STEPS])[0]
    torch.testing.assert_close(positions(theta, effect, x), without, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", sorted(effects()))
def test_a_substep_in_several_launches_is_that_in_one(name, monkeypatch):
    """Large bodies take several launches a substep."""
    effect, x = effects()[name], body()
    whole = positions(present(effect), effect, x)
    monkeypatch.setattr("masiv.mpm.taped_rollout.SERIAL_PARTICLES", 0)
    torch.testing.assert_close(positions(present(effect), effect, x), whole, rtol=0, atol=1e-11)


def test_the_order_of_effects_changes_nothing():
    library, x = effects(), body()
    members = [(library[n], present(library[n])) for n in ("viscosity", "linear_drag", "swirl", "body_force")]
    ends = [
        rollout(simulator(len(x)), LAW, thrown_body(x), STEPS, [STEPS], ActiveEffects(tuple(order), setting(x)))
        for order in (members, members[::-1])
    ]
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=0)


CASES = [(name, "sticky") for name, e in effects().items() if not isinstance(e, SuspendedMassEffect)]
CASES += [(name, c) for name, e in effects().items() if isinstance(e, ContactEffect) for c in ("release", "slip")]


@pytest.mark.parametrize(("name", "contact"), CASES)
def test_gradient_by_finite_differences(name, contact):
    effect, x = effects()[name], body()
    theta = present(effect).requires_grad_()
    weights = torch.rand(len(x), 3, generator=torch.Generator().manual_seed(2), dtype=F64)

    (weights * positions(theta, effect, x, contact)).sum().backward()
    with torch.no_grad():
        for i, parameter in enumerate(effect.parameters):
            step = torch.zeros_like(theta)
            step[i] = 1e-4 * parameter.step  # few nodes begin or cease to slip within it
            up, down = (positions(theta + sign * step, effect, x, contact) for sign in (1, -1))
            moved = up - down
            slope = (weights * moved).sum() / (2 * step[i])
            expected = pytest.approx(slope.item(), rel=2e-4, abs=1e-7 / parameter.step)
            assert theta.grad[i].item() == expected, parameter.name
            # a parameter that moves nothing would pass for any gradient
            assert moved.abs().sum() / 2e-4 > 1e-6, parameter.name


def gradients(effect, contact, dtype):
    """Of a throw's end by its velocity (3,) and spin (3,), and by the effect's parameters."""
    theta, x = present(effect).to(dtype).requires_grad_(), body().to(dtype)
    weights = torch.rand(len(x), 3, generator=torch.Generator().manual_seed(2), dtype=F64)
    active = ActiveEffects(((effect, theta),), setting(x))
    launch = [torch.tensor(v, dtype=dtype, requires_grad=True) for v in ([0.6, -1.2, 0.3], [2.0, 1.0, -3.0])]
    sim = simulator(len(x), contact, dtype=dtype)
    end = rollout(sim, LAW, rigid_initial_state(x, *launch), STEPS, [STEPS], active)[0]
    (weights.to(dtype) * end).sum().backward()
    bars = [*(v.grad for v in launch), torch.zeros_like(theta) if theta.grad is None else theta.grad]
    return torch.cat([bar.to(F64) for bar in bars])


ONE_A_KIND = ("ground_friction", "ground_height", "point_force", "point_mass", "quadratic_drag", "viscosity")
"""On the contact, a shift, a force at a place, masses, on the nodes of the grid, in the stress."""


@pytest.mark.parametrize(
    ("name", "contact"),
    [pytest.param(*c, marks=() if c[0] in ONE_A_KIND and c[1] == "sticky" else pytest.mark.slow) for c in CASES],
)
def test_gradient_in_single_precision(name, contact):
    """What is fitted runs in it, and a compiler that is told to leave out a pass may differentiate it wrongly."""
    double, single = (gradients(effects()[name], contact, dtype) for dtype in (F64, torch.float32))
    torch.testing.assert_close(single, double, rtol=1e-3, atol=1e-4 * float(double.abs().max()))
    assert double[:3].norm() > 1


@pytest.mark.parametrize("name", sorted(effects()))
def test_declaration(name):
    """What the search for causes relies on: steps, bounds that allow zero strength, few guesses, complete ones."""
    effect = effects()[name]
    assert effect.name == name
    assert effect.looks_like
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)
    for p in effect.parameters:
        assert p.unit
        assert p.lower < p.upper
        assert 0 < p.step <= p.upper
    assert effect.strengths >= 1
    assert all(p.lower <= 0 <= p.upper for p in effect.parameters[: effect.strengths])
    guesses = effect.guesses(setting(body()))
    assert 1 <= len(guesses) <= 12
    for guess in guesses:
        located = list(zip(effect.parameters[effect.strengths :], guess, strict=True))
        assert all(p.lower <= value <= p.upper for p, value in located)


def test_two_effects_cannot_both_be_the_contact():
    x = body()
    zero = torch.zeros(1, dtype=F64)
    members = tuple((effects()[name], zero) for name in ("restitution", "ground_friction"))
    with pytest.raises(InputError, match="both replace the contact"):
        ActiveEffects(members, setting(x))


def test_several_effects_at_once():
    """Grid, ground, stress and masses in one rollout: each gradient against finite differences."""
    x = body()
    names = ("linear_drag", "ground_friction", "viscosity", "point_mass", "point_force", "swirl")
    thetas = [present(effects()[name]).requires_grad_() for name in names]

    def loss(values):
        active = ActiveEffects(tuple((effects()[n], v) for n, v in zip(names, values, strict=True)), setting(x))
        return rollout(simulator(len(x)), LAW, thrown_body(x), STEPS, [STEPS], active).square().sum()

    loss(thetas).backward()
    with torch.no_grad():
        for k, name in enumerate(names):
            step = 1e-3 * effects()[name].parameters[0].step
            up, down = ([t.clone() for t in thetas] for _ in range(2))
            up[k][0] += step
            down[k][0] -= step
            slope = (loss(up) - loss(down)) / (2 * step)
            assert thetas[k].grad[0].item() == pytest.approx(slope.item(), rel=2e-4), name


LIFT = """
import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect


@ti.func
def _turned(x, v, t, dt, dx, c):
    return v + dt * c[0] * ti.Vector([-v[1], v[0], 0.0])


class Lift(NodalEffect):
    name = "lift"
    looks_like = "a spinning ball curves"
    parameters = (EffectParameter("rate", "1/s", -20.0, 20.0, 0.05),)

    def node_velocity(self):
        return _turned
"""


@pytest.fixture
def lift(tmp_path, monkeypatch):
    """An effect whose file is added to the folder while masiv runs."""
    (tmp_path / "lift.py").write_text(LIFT)
    monkeypatch.setattr(masiv.effects, "__path__", [*masiv.effects.__path__, str(tmp_path)])
    effects.cache_clear()
    yield effects()["lift"]
    effects.cache_clear()
    sys.modules.pop("masiv.effects.lift")


def test_an_effect_is_added_by_its_file_alone(lift):
    """Found by name, simulated, differentiated."""
    x, theta = body(height=5.0), torch.tensor([3.0], dtype=F64, requires_grad=True)
    start = rigid_initial_state(x, torch.tensor([2.0, 0.0, 1.0], dtype=F64), torch.zeros(3, dtype=F64))
    active = ActiveEffects(((lift, theta),), setting(x))
    last = rollout(simulator(len(x), gravity=(0, 0, 0)), LAW, start, STEPS, [STEPS - 1, STEPS], active)
    velocity = ((last[1] - last[0]) / DT).mean(0)
    expected = 2.0 * (1 + 3j * DT) ** STEPS
    assert velocity.tolist() == pytest.approx([expected.real, expected.imag, 1.0], abs=1e-9)
    velocity[1].backward()
    slope = 2.0 * STEPS * 1j * DT * (1 + 3j * DT) ** (STEPS - 1)
    assert theta.grad.item() == pytest.approx(slope.imag, rel=1e-6)


def test_an_effect_without_its_method_cannot_be_made():
    """Each kind has one abstract method, and an effect of no kind is refused when it is defined."""
    for kind in KINDS:
        assert len(kind.__abstractmethods__) == 1
    with pytest.raises(TypeError, match="node_velocity"):
        type("Nothing", (NodalEffect,), {"name": "nothing"})()
    with pytest.raises(TypeError, match="derive it from one of the kinds"):
        type("Nowhere", (Effect,), {"name": "nowhere"})


def test_values_of_another_shape_are_refused():
    x = body()
    with pytest.raises(InputError, match="linear_drag: values of shape \\(3,\\)"):
        ActiveEffects(((effects()["linear_drag"], torch.zeros(3, dtype=F64)),), setting(x))
