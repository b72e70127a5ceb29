"""Constitutive laws: what must hold whatever the weights are, kernels against definitions, analytic cases."""

import copy
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from law_examples import EXAMPLES, F64, gradients
from scipy.spatial.transform import Rotation
from small import NODES, SUBSTEPS, only_first_quick

from masiv.errors import InputError
from masiv.kernels.lattice import LATTICE_COUNTS, LATTICE_STEP
from masiv.materials import table
from masiv.materials.classical import CONTINUUM, DIFFERENTIABLE, PARAMETERS, ClassicalLaw
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw, strain_invariants
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.pretraining.pretrain import MATERIALS, pretrained_path


def rough(seed):
    """A neural law whose weights are far from anything trained."""
    law = NeuralLaw(stress_scale=1e4, seed=seed).double()
    with torch.no_grad():
        for parameter in law.parameters():
            parameter += torch.randn(parameter.shape, generator=torch.Generator().manual_seed(seed), dtype=F64)
        law.log_flow_strain.clamp_(-5, 0)
    return law


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_neural_law_is_at_rest_when_undeformed(seed):
    law = rough(seed)
    rotation = torch.as_tensor(Rotation.random(random_state=seed).as_matrix())[None]
    for f in (torch.eye(3, dtype=F64)[None], rotation):
        assert float(law.stress(f).detach().abs().max()) < 1e-6 * law.wave_modulus()
        torch.testing.assert_close(law.project(f, 1e-3), f, rtol=0, atol=1e-12)


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_neural_law_is_frame_indifferent_and_isotropic(seed):
    law, f = rough(seed), gradients(8, seed=seed)
    q = torch.as_tensor(Rotation.random(random_state=seed + 1).as_matrix())
    tau, flowed = law.stress(f), law.project(f, 1e-3)
    torch.testing.assert_close(law.stress(q @ f), q @ tau @ q.T, rtol=1e-7, atol=1e-7 * float(tau.detach().abs().max()))
    torch.testing.assert_close(law.project(q @ f, 1e-3), q @ flowed, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(law.stress(f @ q), tau, rtol=1e-7, atol=1e-7 * float(tau.detach().abs().max()))
    torch.testing.assert_close(law.project(f @ q, 1e-3), flowed @ q, rtol=1e-7, atol=1e-9)


def test_neural_stress_orders_as_the_stretches_do():
    """Baker–Ericksen: the larger principal stretch carries the larger principal stress."""
    f = torch.diag_embed(torch.tensor([[1.3, 1.0, 0.8]], dtype=F64))
    for seed in range(20):
        principal = rough(seed).stress(f)[0].diagonal().detach()
        assert principal[0] > principal[1] > principal[2]


def test_flow_does_not_depend_on_the_substep():
    """Two half substeps do what one does, to second order: relaxation is a rate."""
    law, f = NeuralLaw(seed=4).double(), gradients(20, 0.05)
    whole = law.project(f, 2e-4)
    halves = law.project(law.project(f, 1e-4), 1e-4)
    moved = (whole - f).detach().abs().max()
    assert float((whole - halves).detach().abs().max()) < 1e-3 * float(moved)


def yielding(shear_strain=0.05):
    """A neural law whose rate rises by e^30 within a feature's unit around a strain: a yield stress."""
    law = NeuralLaw(stress_scale=1e4, seed=0).double()
    nodes = table.nodes(F64)
    rates = (30.0 * (nodes[:, 1] - math.log(2 * shear_strain / 0.02))).clamp(-14, 14)
    law.rate_table = lambda: torch.stack([rates, torch.full_like(rates, -14.0)], dim=1)
    return law


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_more_strain_never_leaves_less_of_it(seed):
    """What a substep keeps of a pure shear rises with the shear, however steep the rates are."""
    shear = torch.linspace(1e-4, 0.4, 400, dtype=F64)
    f = torch.diag_embed(torch.exp(torch.stack([shear, torch.zeros_like(shear), -shear], dim=1)))
    for law in (rough(seed), yielding(0.001 + 0.1 * (seed % 10))):
        kept = shear * (1 - law.flow_share(strain_invariants(f), 1e-3)[:, 0].detach())
        # The feature is the strain's logarithm to second order: at a strain of 0.4 its slope is 5 % above 1.
        assert float((kept.diff() / shear.diff()).min()) > -0.1


def test_a_steep_rate_is_perfect_plasticity():
    shear = torch.linspace(0.001, 0.4, 400, dtype=F64)
    f = torch.diag_embed(torch.exp(torch.stack([shear, torch.zeros_like(shear), -shear], dim=1)))
    kept = shear * (1 - yielding(0.05).flow_share(strain_invariants(f), 1e-3)[:, 0].detach())
    elastic, beyond = shear < 0.03, shear > 0.1
    torch.testing.assert_close(kept[elastic], shear[elastic], rtol=1e-3, atol=0)
    assert 0.03 < float(kept[beyond].min()) < float(kept[beyond].max()) < 1.1 * float(kept[beyond].min())


def test_the_envelope_is_the_largest_lipschitz_table_below():
    shape = (*LATTICE_COUNTS, 1)
    values = 5 * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    values[20, 10, 4] = 0.0
    out = table.lipschitz_envelope(values.reshape(-1, 1)).reshape(shape)
    assert (out <= values).all()
    for axis in range(3):
        assert float(out.diff(dim=axis).abs().max()) <= LATTICE_STEP + table.ROUNDING
    i, j, k = 22, 9, 7
    cone = sum(abs(a - b) for a, b in zip((i, j, k), (20, 10, 4), strict=True)) * LATTICE_STEP
    assert float(out[i, j, k]) <= cone + 1e-12
    tiny = torch.full((math.prod(LATTICE_COUNTS), 1), 1e-9)
    assert torch.equal(table.lipschitz_envelope(tiny), tiny)


def test_relaxation_removes_strain_and_keeps_volume():
    law, f = NeuralLaw(seed=4).double(), gradients(20, 0.1)
    with torch.no_grad():
        law.plastic[4].weight.zero_()
        law.plastic[4].bias.copy_(torch.tensor([14 * math.atanh(math.log(300.0) / 14), -14.0]))
        left = law.project(f, 1e-3)
    np.testing.assert_allclose(torch.linalg.det(left).numpy(), torch.linalg.det(f).numpy(), rtol=1e-6)
    before, after = (strain_invariants(a)[:, 1:].sum(1) for a in (f, left))
    # The share of Hencky strain left is exp(-0.3), of its square exp(-0.6), to leading order in the strain.
    np.testing.assert_allclose((after / before).numpy(), math.exp(-0.6), rtol=0.05)


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize("name", [*CONTINUUM, "neural"])
def test_kernels_equal_the_definition(name):
    law = rough(3) if name == "neural" else ClassicalLaw(name, **EXAMPLES[name])
    f = gradients(64, 0.1)
    sim = Simulator(particle_count=64, spacing=0.1, substep=1e-3, volume=1.0, density=1.0, gravity=(0, 0, 0), dtype=F64,
                    max_substeps=SUBSTEPS, grid_nodes=NODES)  # fmt: skip
    zeros = torch.zeros(64, 3, dtype=F64)
    sim.kernels.write_state(0, *State(*at_rest(zeros, zeros, torch.zeros_like(f)).tensors()[:3], f).tensors())
    law.bind(sim.kernels, 64, 1e-3).forward(0, 64)
    expected = law.project(f, 1e-3).detach()
    ours = torch.as_tensor(sim.kernels.deformation_gradient.to_numpy()[0, :64])
    stress = torch.as_tensor(sim.kernels.kirchhoff_stress.to_numpy()[0, :64])
    torch.testing.assert_close(ours, expected.expand_as(f).contiguous(), rtol=1e-9, atol=1e-11)
    scale = float(law.stress(expected.expand_as(f)).detach().abs().max())
    torch.testing.assert_close(stress, law.stress(expected.expand_as(f)).detach(), rtol=1e-9, atol=1e-9 * scale)


def test_von_mises_returns_to_its_yield_surface():
    law = ClassicalLaw("von_mises", **EXAMPLES["von_mises"])
    tau = law.stress(law.project(gradients(50, 0.2), 1e-3)).detach()
    deviator = tau - tau.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3)
    # |dev eps| = yield / 2 mu, hence |dev tau| = yield.
    np.testing.assert_allclose(deviator.norm(dim=(1, 2)).numpy(), 3e3, rtol=1e-6)
    small = torch.eye(3, dtype=F64) + 1e-3 * (gradients(5, 1.0) - torch.eye(3))
    torch.testing.assert_close(law.project(small, 1e-3), small)


def test_sand_bears_no_tension_and_stays_in_its_cone():
    law = ClassicalLaw("drucker_prager", **EXAMPLES["drucker_prager"])
    stretched = law.project(1.05 * torch.eye(3, dtype=F64)[None], 1e-3)
    assert float(law.stress(stretched).detach().abs().max()) < 1e-6
    pressed = 0.95 * gradients(50, 0.05)
    tau = law.stress(law.project(pressed, 1e-3)).detach()
    pressure = -tau.diagonal(dim1=1, dim2=2).mean(1)
    deviator = (tau + pressure[:, None, None] * torch.eye(3)).norm(dim=(1, 2))
    sine = math.sin(math.radians(30))
    limit = math.sqrt(2 / 3) * 2 * sine / (3 - sine) * 3 * pressure
    assert bool((deviator <= limit + 1e-6 * deviator.max()).all())
    assert float((deviator / limit).max()) > 0.999


def sheared(law, rate, dt, duration):
    """Stress of a steady simple shear x += rate y t, flowed for ``duration`` [s]."""
    step = torch.eye(3, dtype=F64)[None].clone()
    step[0, 0, 1] = rate * dt
    f = torch.eye(3, dtype=F64)[None]
    for _ in range(round(duration / dt)):
        f = law.project(step @ f, dt)
    return law.stress(f)[0].detach()


@pytest.mark.parametrize("dt", [2e-3, 5e-4, 1e-4])
def test_shear_stress_of_a_newtonian_fluid_is_viscosity_times_rate(dt):
    law = ClassicalLaw("newtonian", **EXAMPLES["newtonian"])
    for rate in (0.5, 5.0, 20.0):
        tau = sheared(law, rate, dt, 0.04)
        assert float(tau[0, 1]) == pytest.approx(40 * rate, rel=0.01)
        assert float((tau - tau.T).abs().max()) < 1e-6
        # The first normal stress difference is second order: 2 x shear stress x rate x (relaxation time or substep).
        assert abs(float(tau[0, 0] - tau[1, 1])) < 2 * 40 * rate * rate * (dt + 5e-4)
    assert float(sheared(law, 0.0, dt, 0.01).abs().max()) == 0


def test_newtonian_shear_converges_as_the_substep_shrinks():
    """While the shear starts, the stress is that of a Maxwell element, eta rate (1 - exp(-t / relaxation time))."""
    law = ClassicalLaw("newtonian", viscosity=4000.0, bulk_modulus=3e5)
    time = 4000 / float(law.elastic_moduli()[0].detach())
    assert time < 2e-3
    exact = 4000 * 2 * (1 - math.exp(-1))
    errors = [abs(float(sheared(law, 2.0, time / n, time)[0, 1]) - exact) for n in (4, 8, 16, 32)]
    assert errors[-1] < 0.02 * exact
    for coarse, fine in itertools.pairwise(errors):
        assert fine == pytest.approx(coarse / 2, rel=0.15)


def test_pressure_of_a_newtonian_fluid_is_taits():
    law = ClassicalLaw("newtonian", **EXAMPLES["newtonian"])
    for j in (0.97, 1.0, 1.02):
        f = law.project(j ** (1 / 3) * torch.eye(3, dtype=F64)[None], 1e-3)
        tau = law.stress(f)[0].detach().numpy()
        # Cauchy pressure of Tait's equation with exponent 7, and Kirchhoff stress -p J.
        pressure = 3e5 / 7 * (j**-7 - 1)
        np.testing.assert_allclose(tau, -pressure * j * np.eye(3), atol=1e-6)


def test_bingham_body_in_simple_shear():
    """yield / sqrt(2) + eta rate above the yield stress; elastic below, where it rests for ever."""
    law = ClassicalLaw("non_newtonian", **EXAMPLES["non_newtonian"])
    for dt in (1e-3, 2.5e-4):
        stresses = [float(sheared(law, rate, dt, 0.4 / rate)[0, 1]) for rate in (2.0, 4.0, 8.0)]
        np.testing.assert_allclose(stresses, [300 / math.sqrt(2) + 15 * rate for rate in (2.0, 4.0, 8.0)], rtol=0.02)
    f = torch.eye(3, dtype=F64)[None].clone()
    f[0, 0, 1] = 0.9 * 300 / math.sqrt(2) / 1e4
    torch.testing.assert_close(law.project(f, 10.0), f, rtol=0, atol=1e-9)


def test_bingham_body_yields_by_hand():
    """One substep of an isochoric stretch and of a pressure, with formulas by hand."""
    law = ClassicalLaw("non_newtonian", **EXAMPLES["non_newtonian"])
    dt, stretch = 1e-3, math.log(1.05)
    f = torch.diag(torch.exp(torch.tensor([stretch, -stretch / 2, -stretch / 2], dtype=F64)))[None]
    size, limit = math.sqrt(1.5) * stretch, 300 / 2e4
    viscous = 15 / (1e4 * dt)
    kept = limit + (size - limit) * viscous / (1 + viscous)
    out = law.project(f, dt)
    assert float(torch.log(out[0, 0, 0].detach())) == pytest.approx(stretch * kept / size, rel=1e-9)
    tau = law.stress(out)[0].detach().numpy()
    np.testing.assert_allclose(np.diag(tau), 2e4 * kept / size * stretch * np.array([1, -0.5, -0.5]), rtol=1e-9)
    squeezed = law.project(0.98 * torch.eye(3, dtype=F64)[None], dt)
    np.testing.assert_allclose(
        law.stress(squeezed)[0].detach().numpy(), 3 * 5e4 * math.log(0.98) * np.eye(3), atol=1e-6
    )


@pytest.mark.parametrize("kind", list(PARAMETERS))
def test_classical_laws_are_at_rest_when_undeformed_and_do_not_see_rotations(kind):
    law, q = ClassicalLaw(kind, **EXAMPLES[kind]), torch.as_tensor(Rotation.random(random_state=5).as_matrix())
    rest = torch.eye(3, dtype=F64)[None]
    assert float(law.stress(law.project(rest, 1e-3)).detach().abs().max()) == 0
    f = 0.97 * gradients(8, 0.05)
    tau, turned = (law.stress(law.project(g, 1e-3)).detach() for g in (f, q @ f))
    torch.testing.assert_close(turned, q @ tau @ q.T, rtol=1e-7, atol=1e-7 * float(tau.abs().max()))


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize("kind", DIFFERENTIABLE)
def test_adjoint_of_a_classical_law_equals_autograd(kind):
    law, f = ClassicalLaw(kind, **EXAMPLES[kind]), gradients(8, 0.05)
    sim = Simulator(particle_count=8, spacing=0.1, substep=1e-3, volume=1.0, density=1.0, gravity=(0, 0, 0), dtype=F64,
                    max_substeps=SUBSTEPS, grid_nodes=NODES)  # fmt: skip
    zeros = torch.zeros(8, 3, dtype=F64)
    sim.kernels.write_state(0, *State(*at_rest(zeros, zeros, torch.zeros_like(f)).tensors()[:3], f).tensors())
    bound = law.bind(sim.kernels, 8, 1e-3)
    bound.forward(0, 8)
    bars = gradients(8, 1.0, seed=1), 1e-4 * gradients(8, 1.0, seed=2)
    sim.kernels.gradient_bar.from_numpy(np.resize(bars[0].numpy(), (1024, 3, 3)))
    sim.kernels.stress_bar.from_numpy(np.resize(bars[1].numpy(), (1024, 3, 3)))
    bound.backward(0, 8)
    trial = f.clone().requires_grad_()
    out = law.project(trial, 1e-3)
    expected = torch.autograd.grad([out, law.stress(out)], [trial, *law.parameters()], bars, allow_unused=True)
    ours = torch.as_tensor(sim.kernels.trial_bar.to_numpy()[:8])
    torch.testing.assert_close(ours, expected[0], rtol=1e-8, atol=1e-8 * float(expected[0].abs().max()))
    for mine, theirs in zip(bound.parameter_gradients(), expected[1:], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=0)


def test_uniaxial_stress_of_neo_hookean_at_small_strain():
    law = ClassicalLaw("neo_hookean", **EXAMPLES["neo_hookean"])
    strain = 1e-4
    stretch = torch.diag(torch.tensor([1 + strain, 1 - 0.3 * strain, 1 - 0.3 * strain], dtype=F64))[None]
    tau = law.stress(stretch)[0].detach()
    assert float(tau[0, 0]) == pytest.approx(1e5 * strain, rel=1e-3)
    assert abs(float(tau[1, 1])) < 1e-3 * float(tau[0, 0])


SQUEEZES = {
    "from one side": (1.0005, 0.998, 1.0005),
    "from all": (0.9995, 0.9985, 0.9995),
    "flat": (1.0007, 0.9985, 1.0007),
}


@pytest.mark.parametrize("squeeze", only_first_quick(SQUEEZES.values()))
@pytest.mark.parametrize("material", list(MATERIALS))
def test_pretrained_law_resembles_its_material(material, squeeze):
    kind, parameters = MATERIALS[material]
    truth, law = ClassicalLaw(kind, **parameters), load_law(pretrained_path(material)).double()
    # Many small substeps: where the material flows, history matters.
    step = torch.diag(torch.tensor(squeeze, dtype=F64))
    states = []
    for each in (truth, law):
        f = torch.eye(3, dtype=F64)[None]
        for _ in range(40):
            f = each.project(step @ f, 5e-4)
        states.append(each.stress(f)[0].detach())
    pressures = [float(stress.trace()) for stress in states]
    assert pressures[1] == pytest.approx(pressures[0], rel=0.06)
    assert float((states[0] - states[1]).norm() / states[0].norm()) < (0.15 if material == "sand" else 0.05)


def test_pretrained_sand_holds_a_slope_and_no_tension():
    """Shear stress over pressure of a cone, at compressions over a decade and a half, when all has flowed that does."""
    kind, parameters = MATERIALS["sand"]
    truth, law = ClassicalLaw(kind, **parameters), load_law(pretrained_path("sand"))
    volume = torch.tensor([-2e-3, -5e-3, -1e-2, -3e-2, -6e-2, 1e-2])
    sheared = volume[:, None] / 3 + 0.05 * torch.tensor([1.0, -1.0, 0.0])
    shares = []
    for each, steps in ((truth, 1), (law, 40)):
        f = torch.diag_embed(torch.exp(sheared))
        with torch.no_grad():
            for _ in range(steps):
                f = each.project(f, 5e-3)
            stress = each.stress(f)
        pressure = -stress.diagonal(dim1=1, dim2=2).mean(1)
        shear = (stress + pressure[:, None, None] * torch.eye(3)).flatten(1).norm(dim=1)
        assert float(shear[-1].abs()) < 1e-3 * float(pressure[3])
        shares.append((shear / pressure)[:-1])
    assert torch.all((shares[1] > 0.6 * shares[0]) & (shares[1] < 1.3 * shares[0])), shares


def test_prior_distance_counts_every_strain_and_no_scale():
    law = NeuralLaw(seed=3).double()
    scaled, other = copy.deepcopy(law), copy.deepcopy(law)
    with torch.no_grad():
        scaled.log_stress_scale += 2.0
        scaled.log_flow_strain -= 1.0
        scaled.log_bulk_ratio += 0.5
        scaled.log_flow_rate += 0.5
        other.elastic[-1].bias[2] += 0.5  # a bulk modulus e^0.5 times as large, at all strains
    assert float(law.prior_distance(law)) == float(scaled.prior_distance(law)) == 0.0
    assert float(other.prior_distance(law)) == pytest.approx(0.5**2 / 4)
    (slope,) = torch.autograd.grad(other.prior_distance(law), other.elastic[-1].bias)
    torch.testing.assert_close(slope, torch.tensor([0.0, 0.0, 0.25, 0.0], dtype=torch.float64))


def test_each_scale_of_a_neural_law_moves_what_it_is_named_after():
    """Factors of e: shear and bulk moduli, the isochoric and the volumetric rate, by the strain features at hand."""
    law = NeuralLaw(seed=3).double()
    factors = {"log_stress_scale": (1, 1, 0, 0), "log_bulk_ratio": (0, 1, 0, 0), "log_flow_rate": (0, 0, 1, 0)}
    for name, expected in factors.items():
        moved = copy.deepcopy(law)
        with torch.no_grad():
            getattr(moved, name).add_(1.0)
        moduli = (moved.moduli_table() - law.moduli_table())[:, [0, 2]]
        # Rates are within e^-14 to e^14 per second, nearly linear where they are small.
        rates = moved.rate_table() - law.rate_table()
        for column, value in zip((*moduli.T, *rates.T), expected, strict=True):
            torch.testing.assert_close(column, torch.full_like(column, value), atol=0.05, rtol=0.0)


@pytest.mark.slow
@torch.no_grad()
def test_a_maxwell_fluid_is_newtonian_in_slow_shear():
    """Simple shear at a rate of 1/s: stress is viscosity times rate, and stays there; pressure is of the volume."""
    shear_modulus, bulk_modulus, relaxation_time, dt = 1e4, 1e5, 5e-3, 2e-4
    law = NeuralLaw.maxwell(
        shear_modulus=shear_modulus, bulk_modulus=bulk_modulus, relaxation_time=relaxation_time
    ).double()  # fmt: skip
    step, f = torch.eye(3, dtype=F64), torch.eye(3, dtype=F64)[None]
    step[0, 1] = 1.0 * dt
    sheared = []
    for _ in range(250):
        f = law.project(step @ f, dt)
        sheared.append(float(law.stress(f)[0, 0, 1]))
    assert sheared[-1] == pytest.approx(shear_modulus * relaxation_time, rel=0.03)
    assert sheared[-1] == pytest.approx(sheared[200], rel=1e-3)
    squeezed = law.project(0.999 * torch.eye(3, dtype=F64)[None], 1.0)
    assert float(law.stress(squeezed)[0, 0, 0]) == pytest.approx(-3e-3 * bulk_modulus, rel=0.01)


def test_a_law_from_before_it_had_a_bulk_ratio_is_read():
    law = NeuralLaw(seed=3)
    old = {name: value for name, value in law.state_dict().items() if name not in ("log_bulk_ratio", "log_flow_rate")}
    read = NeuralLaw(seed=4)
    read.load_state_dict(old)
    torch.testing.assert_close(read.moduli_table(), law.moduli_table())
    torch.testing.assert_close(read.rate_table(), law.rate_table())


def test_laws_survive_saving(tmp_path):
    estimated = ClassicalLaw("von_mises", **EXAMPLES["von_mises"])
    estimated.stderr = {"youngs_modulus": 12.0, "poissons_ratio": math.inf, "yield_stress": 3.0}
    for law in (NeuralLaw(seed=9), estimated):
        law.save(tmp_path / "law.safetensors")
        again = load_law(tmp_path / "law.safetensors")
        f = gradients(5).float() if isinstance(law, NeuralLaw) else gradients(5)
        assert torch.equal(law.stress(f), again.stress(f))
        assert law.description() == again.description()
    assert estimated.description()["parameters"]["youngs_modulus"] == {"value": 1e5, "unit": "Pa", "stderr": 12.0}
    assert estimated.description()["parameters"]["poissons_ratio"]["stderr"] is None
    (tmp_path / "law.safetensors").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="not a law"):
        load_law(tmp_path / "law.safetensors")


def test_bad_parameters_are_named():
    with pytest.raises(InputError, match="unknown classical law"):
        ClassicalLaw("steel")
    with pytest.raises(InputError, match="needs exactly"):
        ClassicalLaw("neo_hookean", youngs_modulus=1.0)
    with pytest.raises(InputError, match="poissons_ratio"):
        ClassicalLaw("neo_hookean", youngs_modulus=1.0, poissons_ratio=0.5)
