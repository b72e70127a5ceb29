"""The simulator against physics, and its adjoint against a float64 twin and finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small import NODES, SUBSTEPS

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.errors import InputError, NonFiniteError
from masiv.identification.neural.starting_law import with_scales
from masiv.materials.classical import ClassicalLaw
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm._reference import _substep
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.pretraining.pretrain import pretrained_path

pytestmark = pytest.mark.usefixtures("taichi")
F64 = torch.float64


def elastic(stiffness=2e4):
    return ClassicalLaw("neo_hookean", youngs_modulus=stiffness, poissons_ratio=0.3)


def simulator(count, **changes):
    settings = dict(
        spacing=0.1, substep=2e-3, volume=0.027, density=1000.0, gravity=(0.0, -9.8, 0.0), dtype=F64,
        max_substeps=SUBSTEPS, grid_nodes=NODES,
    )  # fmt: skip
    return Simulator(particle_count=count, **(settings | changes))


def blob(count=60, height=0.5, seed=1):
    generator = torch.Generator().manual_seed(seed)
    x = 0.3 * torch.rand(count, 3, generator=generator, dtype=F64)
    x[:, 1] += height
    v = 0.3 * torch.randn(count, 3, generator=generator, dtype=F64)
    affine = 0.5 * torch.randn(count, 3, 3, generator=generator, dtype=F64)
    return at_rest(x, v, affine)


def test_ballistic_fall():
    start = rigid_initial_state(
        blob(height=5.0).position, torch.tensor([0.4, 1.0, 0.0]).double(), torch.zeros(3).double()
    )
    steps, dt = 60, 2e-3
    end = simulator(60).run(start, elastic(), steps, [steps]).positions[0]
    # Symplectic Euler falls g t (t + dt) / 2: half a g t^2 to first order in the substep.
    t = steps * dt
    expected = torch.tensor([0.4 * t, 1.0 * t - 0.5 * 9.8 * t * (t + dt), 0.0], dtype=F64)
    np.testing.assert_allclose((end - start.position).numpy(), expected.expand(60, 3).numpy(), atol=1e-12)


def test_momentum_and_angular_momentum_without_forces():
    sim = simulator(60, gravity=(0.0, 0.0, 0.0), contact="none")
    start = blob()
    end = sim.run(start, elastic(), 50, [50]).final

    def momenta(state: State):
        # APIC keeps x × v plus the spin in C, of second moment dx²/4 (Jiang et al. 2015).
        c = state.affine_velocity
        axial = torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], 1)
        spin = torch.linalg.cross(state.position, state.velocity) + sim.spacing**2 / 4 * axial
        return state.velocity.sum(0), spin.sum(0)

    for before, after in zip(momenta(start), momenta(end), strict=True):
        np.testing.assert_allclose(after.numpy(), before.numpy(), atol=1e-10)


def test_bar_rings_at_its_natural_frequency():
    """Free–free bar, nu = 0: first longitudinal mode at sqrt(E / rho) / (2 L)."""
    length, width, spacing, stiffness = 1.0, 0.2, 0.05, 1e5
    axes = [torch.arange(0.5 * spacing / 2, side, spacing / 2, dtype=F64) for side in (length, width, width)]
    x = torch.cartesian_prod(*axes) + torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    mode = torch.cos(math.pi * x[:, 0] / length)
    velocity = torch.zeros_like(x)
    velocity[:, 0] = 0.01 * mode
    law = ClassicalLaw("neo_hookean", youngs_modulus=stiffness, poissons_ratio=0.0)
    dt, steps = 5e-4, 600
    sim = simulator(len(x), spacing=spacing, substep=dt, volume=length * width**2, gravity=(0.0, 0.0, 0.0),
                    contact="none", max_substeps=SUBSTEPS)  # fmt: skip
    affine = torch.zeros(len(x), 3, 3, dtype=F64)
    affine[:, 0, 0] = -0.01 * math.pi / length * torch.sin(math.pi * x[:, 0] / length)
    motion = sim.run(at_rest(x, velocity, affine), law, steps, list(range(steps + 1))).positions
    amplitude = ((motion - x)[:, :, 0] * mode).mean(1).numpy()
    crossings = np.flatnonzero((amplitude[:-1] > 0) & (amplitude[1:] <= 0))
    first = crossings[0] + amplitude[crossings[0]] / (amplitude[crossings[0]] - amplitude[crossings[0] + 1])
    measured = 1 / (2 * first * dt)  # the first return through zero is half a period
    assert measured == pytest.approx(math.sqrt(stiffness / 1000) / (2 * length), rel=0.03)


@pytest.mark.parametrize("contact", ["sticky", "release", "slip"])
@pytest.mark.parametrize(
    "law", [elastic(), NeuralLaw(stress_scale=5e3, seed=3).double()], ids=["neo_hookean", "neural"]
)
def test_substeps_and_gradients_equal_the_twin(law, contact):
    steps = 4
    sim = simulator(40, contact=contact)
    start = blob(40, height=0.02)
    start.velocity[:, 1] -= 1.0
    target = blob(40, seed=7).position

    def loss_and_gradients(run):
        leaves = [t.detach().clone().requires_grad_() for t in start.tensors()]
        loss = ((run(State(*leaves)) - target) ** 2).sum()
        return [loss, *torch.autograd.grad(loss, [*leaves, *law.parameters()], allow_unused=True)]

    def twin(state):
        c = sim.constants
        for _ in range(steps):
            state = _substep(
                state, law, mass=float(sim.mass[0]), volume=c.volume, spacing=sim.spacing, substep=sim.substep,
                gravity=c.gravity, contact=contact,
            )  # fmt: skip
        return state.position

    fast = loss_and_gradients(lambda state: rollout(sim, law, state, steps, [steps])[0])
    slow = loss_and_gradients(twin)
    for a, b in zip(fast, slow, strict=True):
        if b is not None:
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-8 * float(b.detach().abs().max() + 1e-30))


@pytest.mark.parametrize(("height", "steps"), [(0.5, 10), (0.08, 40)], ids=["at_rest", "after_contact"])
def test_rollout_gradient_by_finite_differences(height, steps):
    """Multi-frame loss with respect to the initial velocity and one network weight."""
    law = NeuralLaw(stress_scale=5e3, seed=2).double()
    sim = simulator(60)
    body = blob(60, height=height)  # at F = I, in a motion that strains it
    velocity = torch.tensor([0.3, -1.5, 0.1], dtype=F64, requires_grad=True)
    weights = torch.randn(4, 60, 3, generator=torch.Generator().manual_seed(5), dtype=F64)
    outputs = [steps * k // 4 for k in (1, 2, 3, 4)]

    def loss():
        state = at_rest(body.position, velocity + body.velocity, 8 * body.affine_velocity)
        return (rollout(sim, law, state, steps, outputs) * weights).sum()

    weight = law.elastic[2].weight
    gradients = torch.autograd.grad(loss(), [velocity, weight])
    with torch.no_grad():
        for leaf, gradient, index, step in ((velocity, gradients[0], (1,), 1e-6), (weight, gradients[1], (2, 3), 1e-3)):
            value = float(leaf[index])
            leaf[index] = value + step
            high = float(loss())
            leaf[index] = value - step
            low = float(loss())
            leaf[index] = value
            assert float(gradient[index]) == pytest.approx((high - low) / (2 * step), rel=2e-4)


def test_the_adjoint_of_a_yielding_body_does_not_grow():
    """A rate taken from the strain before a substep made it grow by a factor each: 1e36 within 500 substeps."""
    law = load_law(pretrained_path("plasticine"))
    sim = Simulator(
        particle_count=343, spacing=0.08, substep=6e-4, volume=0.064, density=1000.0, gravity=(0.0, -9.8, 0.0),
        max_substeps=SUBSTEPS, grid_nodes=NODES,
    )  # fmt: skip
    axis = 0.4 * (torch.arange(7) + 0.5) / 7
    x = torch.stack(torch.meshgrid(axis, axis + 0.05, axis, indexing="ij"), -1).reshape(-1, 3)
    velocity = torch.tensor([0.3, -3.0, 0.0], requires_grad=True)
    soft = with_scales(law, 5e4)
    path = rollout(sim, soft, at_rest(x, velocity.expand(343, 3), torch.zeros(343, 3, 3)), 400, [400])[0]
    (gradient,) = torch.autograd.grad(path.mean(0)[0], [velocity])
    duration = 400 * 6e-4
    assert float(gradient.norm()) < 3 * duration


def test_rollout_is_bit_reproducible_and_segments_do_not_change_it():
    law = elastic()
    start = State(*(t.float() for t in blob(200, height=0.05).tensors()))
    roomy = simulator(200, dtype=torch.float32)
    tight = simulator(200, dtype=torch.float32, memory_mb=7)  # a few dozen states at most
    assert tight.kernels.capacity_steps < 50 <= roomy.kernels.capacity_steps

    def run(sim):
        x = start.position.clone().requires_grad_()
        state = State(x, start.velocity, start.affine_velocity, start.trial_gradient)
        end = rollout(sim, law, state, 50, [30, 50])
        return end.detach(), torch.autograd.grad(end.square().sum(), [x, *law.parameters()])

    first, second, segmented = run(roomy), run(roomy), run(tight)
    for other in (second, segmented):
        assert torch.equal(first[0], other[0])
        assert all(torch.equal(a, b) for a, b in zip(first[1], other[1], strict=True))


def test_substeps_launched_at_once_and_one_by_one_and_in_parts_are_the_same(monkeypatch):
    start = State(*(t.float() for t in blob(200, height=0.05).tensors()))
    law = elastic()
    ends = []
    for serial in (10**6, 0):
        monkeypatch.setattr("masiv.mpm.taped_rollout.SERIAL_PARTICLES", serial)
        ends.append(simulator(200, dtype=torch.float32).run(start, law, 40, [13, 40]).positions)
    context = EffectContext(torch.tensor([0.0, -9.8, 0.0]), start.position, 0.135, 0.3, 0.08)
    no_drag = ActiveEffects(((effect_named("linear_drag"), torch.zeros(1)),), context)  # launch by launch
    ends.append(simulator(200, dtype=torch.float32).run(start, law, 40, [13, 40], no_drag).positions)
    for end in ends[1:]:
        np.testing.assert_allclose(end.numpy(), ends[0].numpy(), atol=1e-6)


def test_result_does_not_depend_on_the_mass_of_a_particle():
    """Volume and mass per particle cancel for one material: stress over density decides."""
    start = blob(60, height=0.05)
    one, two = (simulator(60, volume=v).run(start, elastic(), 40, [40]).positions for v in (0.027, 0.081))
    np.testing.assert_allclose(one.numpy(), two.numpy(), atol=1e-10)


def test_body_rests_on_the_ground_at_its_true_height():
    """No clamp lifts what starts near the plane: a particle 1 mm above it stays there."""
    x = blob(60, height=0.0).position
    x[0, 1] = 1e-3
    state = rigid_initial_state(x, torch.zeros(3).double(), torch.zeros(3).double())
    end = simulator(60, gravity=(0.0, 0.0, 0.0)).run(state, elastic(), 10, [10]).positions[0]
    np.testing.assert_allclose(end.numpy(), x.numpy(), atol=1e-12)


def test_divergence_names_substep_and_particle():
    start = blob(60)
    start.velocity[17] = float("nan")
    with pytest.raises(NonFiniteError) as caught:
        simulator(60).run(start, elastic(), 8, [8])
    assert caught.value.substep == 0
    fast = blob(60)
    fast.velocity[:] = 100.0
    with pytest.raises(NonFiniteError, match="substep 0"):
        simulator(60).run(fast, elastic(), 8, [8])


def test_shapes_are_checked_before_taichi_sees_them():
    sim, start = simulator(60), blob(60)
    with pytest.raises(InputError, match="velocity has shape \\(59, 3\\), the simulator needs \\(60, 3\\)"):
        sim.run(replace(start, velocity=start.velocity[1:]), elastic(), 8, [8])
    with pytest.raises(InputError, match="ascending substeps from 0 to 8"):
        sim.run(start, elastic(), 8, [9])
    with pytest.raises(InputError, match="at least 1"):
        sim.run(start, elastic(), 0, [])
    with pytest.raises(InputError, match="gravity"):
        simulator(60, gravity=(0.0, -9.8))
    with pytest.raises(InputError, match="unknown contact 'glue'"):
        simulator(60, contact="glue")
    with pytest.raises(InputError, match="density = -1"):
        simulator(60, density=-1.0)


def test_memory_counts_states_and_grids():
    """Of a simulator with room for as many substeps as memory allows, both together stay within it."""
    k = simulator(200, dtype=torch.float32, memory_mb=6, max_substeps=1 << 14).kernels
    state = sum(
        int(np.prod(field.shape[1:])) * field.n * field.m
        for field in (k.position, k.velocity, k.affine_velocity, k.trial_gradient, k.deformation_gradient,
                      k.kirchhoff_stress)
    )  # fmt: skip
    log = 4 * (k.capacity_log - k.capacity_nodes) / k.capacity_steps
    kept = 4 * k.capacity_steps * (state + log)
    assert 3e6 < kept <= 6e6
