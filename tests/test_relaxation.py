"""Maxwell branches beside a law, against linear viscoelasticity on paper and the limits of slow and fast branches."""

import numpy as np
import pytest
import taichi as ti
import torch
from effect_cases import F64, LAW, STEPS, body, setting, simulator
from test_effects import thrown_body

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.relaxation import shear_moduli
from masiv.errors import InputError
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.rollout import at_rest, rollout

WEIGHTLESS = (0.0, 0.0, 0.0)
THETA = torch.tensor([0.5, 0.3, 0.2, 0.02, 0.3, 2.0], dtype=F64)


@pytest.fixture(scope="module")
def branch(taichi):
    """(elastic shear stress (T,), shear rate (T,) [1/s], fraction, time [s], dt [s]) -> h (T,) of one branch."""
    function = effects()["relaxation"].particle_stress()

    @ti.kernel
    def run(tau: ti.types.ndarray(), rate: ti.types.ndarray(), fraction: ti.f64, time: ti.f64, dt: ti.f64,
            out: ti.types.ndarray()):  # fmt: skip
        ti.loop_config(serialize=True)
        for _ in range(1):
            q = ti.Vector.zero(ti.f64, 6)
            zero, eye = ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.identity(ti.f64, 3)
            for s in range(tau.shape[0]):
                stress, velocity_gradient = zero, zero
                stress[0, 1], stress[1, 0], velocity_gradient[0, 1] = tau[s], tau[s], rate[s]
                known = ti.cast(ti.min(s, 1), ti.f64)
                c = ti.Vector([fraction, 1 / time])
                h, q_after = function(stress, eye, velocity_gradient, q, dt, known, c)
                q = q_after
                out[s] = h[0, 1]

    def of(tau, rate, fraction, time, dt):
        out = np.empty(len(tau))
        run(np.ascontiguousarray(tau), np.ascontiguousarray(rate), fraction, time, dt, out)
        return out

    return of


def test_stress_after_a_sudden_strain(branch):
    dt, t = 1e-3, np.arange(400) * 1e-3
    tau = np.where(t > 0, 100.0, 0.0)
    h = branch(tau, 0 * t, 0.5, 0.1, dt)
    assert h[0] == 0
    # the step is spread over a substep, in whose middle it is taken to be
    np.testing.assert_allclose(h[1:], 50.0 * np.exp(-(t[1:] - dt / 2) / 0.1), rtol=1e-12)


@pytest.mark.parametrize("frequency", [0.1, 1.0, 8.0])
def test_storage_and_loss_modulus(branch, frequency):
    modulus, amplitude, dt = 8e4, 1e-5, 1 / (frequency * 2000)
    t = np.arange(round(max(12.0, 3 / frequency) / dt)) * dt  # six of the slowest times: the start is forgotten
    omega = 2 * np.pi * frequency
    strain = amplitude * np.sin(omega * t)
    rate = np.diff(strain, prepend=0.0) / dt
    branches = zip(THETA[:3].tolist(), THETA[3:].tolist(), strict=True)
    h = sum(branch(modulus * strain, rate, fraction, time, dt) for fraction, time in branches)
    total = (modulus * strain + h)[-2000:]
    last = t[-2000:]
    storage, loss = (2 * np.mean(total * wave(omega * last)) / amplitude for wave in (np.sin, np.cos))
    expected = [float(m) for m in shear_moduli(THETA, modulus, torch.tensor([frequency], dtype=F64))]
    assert [storage, loss] == pytest.approx(expected, rel=4e-3)


def test_creep_under_a_constant_stress(branch):
    """A Zener solid: J(t) = (1 - g / (1 + g) exp(-t / ((1 + g) T))) / G. The elastic stress that it implies must leave
    the total stress as it is."""
    fraction, time, dt = 0.6, 0.2, 1e-3
    t = np.arange(2000) * dt
    elastic = 100.0 * (1 - fraction / (1 + fraction) * np.exp(-t / ((1 + fraction) * time)))
    elastic[0] = 0.0  # at rest before the load
    h = branch(elastic, 0 * t, fraction, time, dt)
    np.testing.assert_allclose((elastic + h)[1:], 100.0, rtol=2e-3)


def stretched(x):
    """A body in flight that is stretched along x, at a rate of 4 /s."""
    rate = torch.diag(torch.tensor([4.0, -2.0, -2.0], dtype=F64))
    middle = x.mean(0)
    return at_rest(x, (x - middle) @ rate.T, rate.expand(len(x), 3, 3))


def flight(name, theta, law=LAW, steps=60, state=None):
    x = body(height=5.0)
    active = ActiveEffects(((effects()[name], torch.tensor(theta, dtype=F64)),), setting(x)) if name else None
    with torch.no_grad():
        return rollout(simulator(len(x), gravity=WEIGHTLESS), law, state or stretched(x), steps, [steps], active)[0]


def test_a_slow_branch_adds_to_the_shear_modulus():
    fraction, lame, shear = 0.8, 2e4 * 0.3 / (1.3 * 0.4), 2e4 / 2.6
    bulk, stiffer = lame + 2 / 3 * shear, (1 + fraction) * shear
    nu = (3 * bulk - 2 * stiffer) / (2 * (3 * bulk + stiffer))
    law = ClassicalLaw("neo_hookean", youngs_modulus=2 * stiffer * (1 + nu), poissons_ratio=nu)
    without, expected = flight(None, []), flight(None, [], law)
    found = flight("relaxation", [fraction, 0, 0, 100.0, 1.0, 1.0])
    assert (found - expected).norm() < 0.03 * (found - without).norm()


def test_a_fast_branch_is_a_viscosity():
    """Of fraction * time * shear modulus, but for what happens within that time."""
    fraction, time, shear = 2.0, 1e-3, 2e4 / 2.6
    without, expected = flight(None, []), flight("viscosity", [fraction * time * shear])
    found = flight("relaxation", [0, 0, fraction, 1.0, 1.0, time])
    assert (found - expected).norm() < 0.2 * (expected - without).norm()


def test_a_rollout_goes_on_from_a_state():
    x = body()
    active = ActiveEffects(((effects()["relaxation"], THETA),), setting(x))
    sim = simulator(len(x))
    whole = sim.run(thrown_body(x), LAW, STEPS, [], active).final
    first = sim.run(thrown_body(x), LAW, STEPS // 2, [], active).final
    second = sim.run(first, LAW, STEPS - STEPS // 2, [], active).final
    torch.testing.assert_close(second.position, whole.position, rtol=0, atol=1e-14)
    torch.testing.assert_close(second.internal_variables, whole.internal_variables, rtol=1e-12, atol=1e-12)
    assert whole.internal_variables.abs().max() > 1


@pytest.mark.slow
def test_gradient_of_a_rollout_of_several_segments():
    x, steps = body(), 100
    sim = simulator(len(x))
    assert steps > sim.kernels.capacity_steps
    theta = THETA.clone().requires_grad_()

    def end(values):
        active = ActiveEffects(((effects()["relaxation"], values),), setting(x))
        return (rollout(sim, LAW, thrown_body(x), steps, [steps], active)[0] ** 2).sum()

    end(theta).backward()
    with torch.no_grad():
        for i in (0, 2, 3):
            step = torch.zeros_like(theta)
            step[i] = 1e-5
            slope = (end(theta + step) - end(theta - step)) / 2e-5
            assert theta.grad[i].item() == pytest.approx(slope.item(), rel=1e-4)


def test_two_effects_with_a_history_are_refused():
    x = body()
    member = (effects()["relaxation"], THETA)
    with pytest.raises(InputError, match="internal variables"):
        ActiveEffects((member, member), setting(x))
