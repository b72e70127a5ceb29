"""A body of springs: conservation laws, the stiffness of a bar, gradients, effects."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.materials.classical import ClassicalLaw
from masiv.mpm import spring_rollout
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.spring_graph import NEIGHBOURS, spring_graph

DENSITY = 1000.0

pytestmark = pytest.mark.usefixtures("taichi")


def lattice(*counts, spacing=0.02, jitter=0.0, base=0.1):
    axes = [spacing * (np.arange(n) + 0.5) for n in counts]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points + jitter * spacing * np.random.default_rng(0).uniform(-1, 1, points.shape)
    return torch.tensor(points + np.array([0.0, base, 0.0]))


def simulator_of(x, *, spacing=0.02, substep=2e-4, gravity=(0.0, 0.0, 0.0), contact="none", **more):
    count = len(x)
    return Simulator(
        particle_count=count, spacing=1.8 * spacing, substep=substep, volume=count * spacing**3, density=DENSITY,
        gravity=gravity, contact=contact, dtype=torch.float64, **more,
    )  # fmt: skip


def springs(youngs_modulus=1e5, viscosity=1.0):
    return ClassicalLaw("springs", youngs_modulus=youngs_modulus, viscosity=viscosity)


def start(x, velocity=None):
    v = torch.zeros_like(x) if velocity is None else velocity
    return at_rest(x, v, torch.zeros(len(x), 3, 3, dtype=x.dtype))


def context_of(x):
    mass = DENSITY * 0.02**3
    return EffectContext(torch.tensor([0.0, -9.8, 0.0], dtype=x.dtype), x, mass, 0.1, 1.0)


def effects_of(x, **members):
    found = tuple((effect_named(n), torch.tensor(v, dtype=torch.float64)) for n, v in members.items())
    return ActiveEffects(found, context_of(x))


def test_weights_of_a_particle_sum_to_one_and_a_bond_is_in_the_rows_of_both_ends():
    x = lattice(5, 6, 7, jitter=0.3).numpy()
    graph = spring_graph(x)
    rows = np.repeat(np.arange(len(x)), np.diff(graph.offsets))
    assert graph.weights.sum() == pytest.approx(2 * len(x))
    assert np.diff(graph.offsets).min() >= NEIGHBOURS
    entries = {(i, j): (w, r) for i, j, w, r in zip(rows, graph.others, graph.weights, graph.lengths, strict=True)}
    assert all(entries[j, i] == entry for (i, j), entry in entries.items())
    assert all(i != j for i, j in entries)


def test_momentum_and_angular_momentum_are_kept():
    x = lattice(4, 5, 6, jitter=0.3)
    v = torch.tensor(np.random.default_rng(1).normal(0, 0.5, (len(x), 3)))
    done = simulator_of(x).run(start(x, v), springs(viscosity=5.0), 300, [300])
    final = done.final
    assert torch.allclose(final.velocity.sum(0), v.sum(0), atol=1e-10)
    spin, before = (torch.linalg.cross(a, b).sum(0) for a, b in ((final.position, final.velocity), (x, v)))
    assert torch.allclose(spin, before, atol=1e-10)
    assert final.velocity.square().sum() < 0.8 * v.square().sum()  # dampers and disorder take from it


def test_a_rigid_rotation_strains_nothing():
    x = lattice(4, 4, 4, jitter=0.2)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 0.3], [1, 0, 0.2], [-0.3, -0.2, 0]]).double())
    state = start((x - x.mean(0)) @ turn.T)
    final = simulator_of(x).run(replace(state, rest_position=x), springs(), 50, [50]).final
    assert torch.allclose(final.position, state.position, atol=1e-12)
    assert torch.allclose(final.trial_gradient, turn.expand(len(x), 3, 3), atol=1e-9)


@pytest.mark.parametrize("modulus", [2e4, 2e5])
def test_a_free_bar_vibrates_at_the_frequency_of_its_modulus(modulus):
    """f = sqrt(E / rho) / (2 L) of the first longitudinal mode of a thin bar."""
    spacing, counts = 0.01, (4, 4, 40)
    x = lattice(*counts, spacing=spacing, jitter=0.1)
    length = counts[2] * spacing
    v = torch.zeros_like(x)
    along = x[:, 2] / length
    v[:, 2] = -0.05 * torch.cos(torch.pi * along)
    period = 2 * length / np.sqrt(modulus / DENSITY)
    step = 1e-4 * np.sqrt(2e5 / modulus)
    steps = round(1.5 * period / step)
    outputs = list(range(0, steps, 4))
    simulator = simulator_of(x, spacing=spacing, substep=step)
    positions = simulator.run(start(x, v), springs(modulus, 0.01), steps, outputs).positions
    amplitude = ((positions - x)[..., 2] * torch.cos(torch.pi * along)).sum(1)
    sign = torch.sign(amplitude[1:])
    change = torch.nonzero(sign[1:] != sign[:-1])[:, 0] + 2
    assert change[1] * 4 * step == pytest.approx(period, rel=0.05)  # zero at half a period and at a whole one


def test_the_stress_of_a_strained_neighbourhood_is_that_of_a_solid_with_this_modulus():
    law, strain = springs(1e5), 1e-6 * torch.tensor([[1.0, 0.3, 0], [0.3, -2.0, 0.5], [0, 0.5, 0.7]]).double()
    solid = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.25)
    f = (torch.eye(3).double() + strain)[None]
    assert torch.allclose(law.stress(f), solid.stress(f), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("contact", ["none", "sticky", "slip"])
def test_gradients_match_finite_differences(contact, parallel, monkeypatch):
    """By the state, the law's parameters, a load and a force; memory for a part of the rollout alone."""
    monkeypatch.setattr(spring_rollout, "SERIAL_PARTICLES", 0 if parallel else 100)
    x = lattice(3, 3, 4, jitter=0.2, base=0.012)
    rng = np.random.default_rng(2)
    v = torch.tensor(rng.normal(0, 0.2, (len(x), 3))) - torch.tensor([0.5, 1.0, 0.0])
    weights = torch.tensor(rng.normal(size=(3, len(x), 3)))
    sim = simulator_of(x, gravity=(0.0, -9.8, 0.0), contact=contact, friction=0.4)
    sim._memory_mb = 0.1
    loads = [torch.tensor(t).double() for t in ([0.02, 0.03, 0.05, 0.03], [0.3, 0.2, -0.4, 0.03, 0.05, 0.03])]
    given = [x, v, torch.tensor(5e4).double(), torch.tensor(3.0).double(), *loads]

    def loss(position, velocity, modulus, viscosity, *thetas):
        law = springs(modulus.item(), viscosity.item())
        names = ("point_mass", "point_force")
        active = ActiveEffects(tuple(zip(map(effect_named, names), thetas, strict=True)), context_of(x))
        state = replace(start(position, velocity), rest_position=x)
        return (weights * rollout(sim, law, state, 120, [0, 50, 120], active)).sum(), law

    leaves = [t.clone().requires_grad_() for t in given]
    value, law = loss(*leaves)
    value.backward()
    moduli = [law.values[name].grad for name in ("youngs_modulus", "viscosity")]
    found = [leaves[0].grad, leaves[1].grad, *moduli, *(t.grad for t in leaves[4:])]
    for index, gradient in enumerate(found):
        way = torch.tensor(rng.normal(size=given[index].shape))
        step = 1e-6 * float(given[index].abs().max())
        with torch.no_grad():
            ends = [loss(*given[:index], given[index] + d * way, *given[index + 1 :])[0] for d in (step, -step)]
        assert float((gradient * way).sum()) == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-4), index


def test_one_thread_and_many_segments_give_what_all_threads_give(monkeypatch):
    x = lattice(4, 4, 4, jitter=0.2, base=0.0)
    sim = simulator_of(x, gravity=(0.0, -9.8, 0.0), contact="slip", friction=0.3)
    whole = sim.run(start(x), springs(), 200, [50, 200]).positions
    monkeypatch.setattr(spring_rollout, "SERIAL_PARTICLES", 0)
    sim._memory_mb = 0.1
    assert torch.allclose(sim.run(start(x), springs(), 200, [50, 200]).positions, whole, rtol=0, atol=1e-12)


def test_a_rollout_goes_on_from_its_final_state():
    x = lattice(3, 4, 4, jitter=0.2, base=0.0)
    sim = simulator_of(x, gravity=(0.0, -9.8, 0.0), contact="sticky")
    whole = sim.run(start(x), springs(), 200, [200]).positions[0]
    half = sim.run(start(x), springs(), 100, []).final
    assert torch.allclose(sim.run(half, springs(), 100, [100]).positions[0], whole, rtol=0, atol=1e-13)


def test_more_viscous_springs_take_shorter_substeps_and_stay_stable():
    x = lattice(4, 4, 4, jitter=0.2)
    v = torch.tensor(np.random.default_rng(1).normal(0, 0.5, (len(x), 3)))
    final = simulator_of(x).run(start(x, v), springs(1e4, 100.0), 100, []).final
    assert final.velocity.square().sum() < 0.2 * v.square().sum()
    with pytest.raises(MasivError, match="too stiff, or too viscous"):
        simulator_of(x, substep=0.1).run(start(x, v), springs(1e9, 100.0), 100, [])


def test_a_block_comes_to_rest_on_the_ground_and_slides_with_its_friction():
    x = lattice(4, 4, 4, base=0.0)
    v = torch.zeros_like(x)
    v[:, 0] = 1.0
    sim = simulator_of(x, gravity=(0.0, -9.8, 0.0), contact="slip", friction=0.2)
    final = sim.run(start(x, v), springs(1e5, 20.0), 1000, []).final
    assert final.velocity[:, 0].mean() == pytest.approx(1.0 - 0.2 * 9.8 * 0.2, rel=0.05)
    assert final.position[:, 1].min() > 0.005


def test_effects_on_the_grid_act_on_the_particles():
    """Linear drag: v = v0 exp(-k t)."""
    x = lattice(3, 3, 3)
    v = torch.ones_like(x)
    active = effects_of(x, linear_drag=[2.0])
    final = simulator_of(x).run(start(x, v), springs(), 1000, [], active).final
    assert torch.allclose(final.velocity, v * np.exp(-2.0 * 0.2), rtol=1e-3)
    motion = rollout(simulator_of(x), springs(), start(x, v.requires_grad_()), 2, [2], active)
    with pytest.raises(MasivError, match="no adjoint with linear_drag"):
        motion.sum().backward()


def test_what_springs_cannot_do_is_said():
    x = lattice(3, 3, 3)
    with pytest.raises(MasivError, match="viscosity acts on the stress, which springs do not have"):
        simulator_of(x).run(start(x), springs(), 1, [], effects_of(x, viscosity=[5.0]))
    with pytest.raises(InputError, match="deformed, and its positions at rest are not known"):
        simulator_of(x).run(replace(start(x), trial_gradient=2 * start(x).trial_gradient), springs(), 1, [])
    with pytest.raises(InputError, match="two particles are in one place"):
        spring_graph(np.zeros((40, 3)))
    with pytest.raises(InputError, match="4 particles, give at least 5"):
        spring_graph(np.eye(4)[:, :3])
    broken = torch.zeros_like(x)
    broken[7] = torch.nan
    with pytest.raises(NonFiniteError, match="substep 0"):
        simulator_of(x).run(start(x, broken), springs(), 5, [])


def test_the_stress_of_a_strained_body_is_read_from_its_particles():
    x = lattice(5, 5, 5, jitter=0.2)
    f = torch.eye(3).double() + torch.tensor([[0.1, 0.05, 0], [0, -0.05, 0], [0, 0, 0.02]]).double()
    state = replace(start(x @ f.T), rest_position=x)
    gradient, stress = simulator_of(x).run(state, springs(), 1, []).read_stress(0)
    assert torch.allclose(gradient, f.expand_as(gradient), atol=1e-8)
    assert torch.allclose(stress, springs().stress(f[None]).expand_as(stress), rtol=1e-6, atol=1e-2)
