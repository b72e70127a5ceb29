"""Every effect of the library: absent at zero strength, its gradient against finite differences."""

from __future__ import annotations

import pytest
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import Setting
from masiv.effects.library import effects
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.rollout import rollout
from masiv.mpm.simulate import thrown
from masiv.mpm.simulator import Simulator

F64 = torch.float64
DT, STEPS = 1e-3, 40
LAW = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)


def body(count=200, height=0.02):
    generator = torch.Generator().manual_seed(1)
    x = 0.2 * torch.rand(count, 3, generator=generator, dtype=F64)
    x[:, 1] += height
    return x


def setting(x):
    return Setting(torch.tensor([0.0, -9.8, 0.0], dtype=F64), x, 1e3 * 0.2**3 / len(x), 0.2, STEPS * DT)


def simulator(count, contact="sticky"):
    return Simulator(particle_count=count, spacing=0.05, substep=DT, volume=0.2**3, density=1e3, gravity=(0, -9.8, 0),
                     contact=contact, dtype=F64, max_substeps=64, grid_nodes=1 << 14)  # fmt: skip


def positions(theta, effect, x, outputs=(STEPS,)):
    """The throw with the effect: position and time shifts are the caller's, so they are applied here."""
    active = ActiveEffects(((effect, theta),), setting(x))
    zero = torch.zeros(1, dtype=F64)
    shift = torch.cat([zero, active.ground_shift().to(F64).reshape(1), zero])
    velocity = torch.tensor([0.6, -1.2, 0.3], dtype=F64)
    omega = torch.tensor([2.0, 1.0, -3.0], dtype=F64)
    state = thrown(x - shift, velocity, omega)
    return rollout(simulator(len(x)), LAW, state, STEPS, list(outputs), active) + shift


def present(effect):
    """Parameters of a clear case of the effect."""
    first = effect.guesses(setting(body()))[0]
    strengths = [8 * p.step for p in effect.parameters[: effect.strengths]]
    return torch.tensor([*strengths, *first], dtype=F64)


@pytest.mark.parametrize("name", sorted(effects()))
def test_absent_at_zero_strength(name):
    effect, x = effects()[name], body()
    theta = present(effect)
    theta[: effect.strengths] = 0
    without = rollout(simulator(len(x)), LAW, thrown(x, torch.tensor([0.6, -1.2, 0.3], dtype=F64),
                      torch.tensor([2.0, 1.0, -3.0], dtype=F64)), STEPS, [STEPS])  # fmt: skip
    torch.testing.assert_close(positions(theta, effect, x), without, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", sorted(n for n, e in effects().items() if e.on_grid or e.on_stress or n == "point_mass"))
def test_gradient_by_finite_differences(name):
    effect, x = effects()[name], body()
    theta = present(effect).requires_grad_()
    weights = torch.rand(1, len(x), 3, generator=torch.Generator().manual_seed(2), dtype=F64)

    def loss(value):
        return (weights * positions(value, effect, x)).sum()

    loss(theta).backward()
    for i, parameter in enumerate(effect.parameters):
        step = torch.zeros_like(theta)
        step[i] = 1e-3 * parameter.step
        slope = (loss(theta.detach() + step) - loss(theta.detach() - step)) / (2 * step[i])
        assert theta.grad[i].item() == pytest.approx(slope.item(), rel=2e-4, abs=1e-7 / parameter.step), parameter.name
