"""The correction of a classical law: the law at the start, guarantees whatever the weights are, adjoints."""

import numpy as np
import pytest
import torch
from cube import noisy, scene
from law_examples import EXAMPLES, F64, gradients
from scipy.spatial.transform import Rotation
from small import NODES, SMALL, SUBSTEPS

from masiv.checkpoint import Checkpoint
from masiv.identification.config import IdentifyConfig
from masiv.identification.stage import identify
from masiv.materials.adapter import AdapterLaw
from masiv.materials.classical import CONTINUUM, ClassicalLaw
from masiv.materials.load import load_law
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State


def adapter(kind, seed=None):
    """Zero at the start, or far from it."""
    law = AdapterLaw(ClassicalLaw(kind, **EXAMPLES[kind]), rank=2, seed=1).double()
    if seed is not None:
        with torch.no_grad():
            law.up.weight += torch.randn(4, 2, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return law


@pytest.mark.parametrize("kind", CONTINUUM)
def test_an_adapter_starts_as_its_classical_law(kind):
    base, law = ClassicalLaw(kind, **EXAMPLES[kind]), adapter(kind)
    trial = torch.cat([gradients(40, 0.03), 0.95 * gradients(20, 0.02, seed=1)])
    exact, ours = base.project(trial, 1e-3).detach(), law.project(trial, 1e-3).detach()
    strains = [(f @ f.mT - torch.eye(3)).abs().max() for f in (trial, exact - ours + torch.eye(3))]
    # Where all strain flows at once, a third order of it is left to the next substep.
    assert float(strains[1]) < (0.05 if kind == "water" else 0.01) * float(strains[0])
    tau, tau_base = law.stress(exact).detach(), base.stress(exact).detach()
    tolerance = 1e-9 if kind in ("neo_hookean", "newtonian", "water") else 0.01
    assert float((tau - tau_base).abs().max()) <= tolerance * float(tau_base.abs().max())
    assert law.wave_modulus() == pytest.approx(base.wave_modulus(), rel=1e-6)


@pytest.mark.parametrize("kind", CONTINUUM)
def test_an_adapter_is_at_rest_isotropic_and_frame_indifferent(kind):
    q = torch.as_tensor(Rotation.random(random_state=3).as_matrix())
    for seed in range(5):
        law, f = adapter(kind, seed), 0.98 * gradients(6, 0.05, seed=seed)
        rest = torch.eye(3, dtype=F64)[None]
        assert float(law.stress(rest).detach().abs().max()) == 0
        torch.testing.assert_close(law.project(rest, 1e-3).detach(), rest, rtol=0, atol=1e-12)
        tau, flowed = law.stress(f).detach(), law.project(f, 1e-3).detach()
        near = dict(rtol=1e-7, atol=1e-7 * float(tau.abs().max()))
        torch.testing.assert_close(law.stress(q @ f).detach(), q @ tau @ q.T, **near)
        torch.testing.assert_close(law.stress(f @ q).detach(), tau, **near)
        torch.testing.assert_close(law.project(q @ f, 1e-3).detach(), q @ flowed, rtol=1e-7, atol=1e-9)


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize("kind", ["neo_hookean", "newtonian", "von_mises", "non_newtonian"])
def test_kernels_of_an_adapter_equal_its_definition_and_its_gradient(kind):
    law, f = adapter(kind, seed=2), gradients(16, 0.05)
    sim = Simulator(particle_count=16, spacing=0.1, substep=1e-3, volume=1.0, density=1.0, gravity=(0, 0, 0), dtype=F64,
                    max_substeps=SUBSTEPS, grid_nodes=NODES)  # fmt: skip
    zeros = torch.zeros(16, 3, dtype=F64)
    sim.kernels.write_state(0, *State(*at_rest(zeros, zeros, torch.zeros_like(f)).tensors()[:3], f).tensors())
    bound = law.bind(sim.kernels, 16, 1e-3)
    bound.forward(0, 16)
    out = law.project(f, 1e-3)
    ours = torch.as_tensor(sim.kernels.deformation_gradient.to_numpy()[0, :16])
    torch.testing.assert_close(ours, out.detach(), rtol=1e-8, atol=1e-9)
    bars = gradients(16, 1.0, seed=1), 1e-4 * gradients(16, 1.0, seed=2)
    sim.kernels.gradient_bar.from_numpy(np.resize(bars[0].numpy(), (1024, 3, 3)))
    sim.kernels.stress_bar.from_numpy(np.resize(bars[1].numpy(), (1024, 3, 3)))
    bound.backward(0, 16)
    trial = f.clone().requires_grad_()
    trained = [p for p in law.parameters() if p.requires_grad]
    out = law.project(trial, 1e-3)
    expected = torch.autograd.grad([out, law.stress(out)], [trial, *trained], bars)
    trial_bar = torch.as_tensor(sim.kernels.trial_bar.to_numpy()[:16])
    torch.testing.assert_close(trial_bar, expected[0], rtol=1e-6, atol=1e-7 * float(expected[0].abs().max()))
    found = [g for g in bound.parameter_gradients() if g is not None]
    for mine, theirs in zip(found, expected[1:], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-7 * float(theirs.abs().max()))


def test_an_adapter_survives_saving(tmp_path):
    law = adapter("von_mises", seed=4).float()
    law.base.double()
    law.base.stderr = {"yield_stress": 5.0}
    law.save(tmp_path / "law.safetensors")
    again = load_law(tmp_path / "law.safetensors")
    f = gradients(5, 0.05).float()
    assert torch.equal(law.stress(f), again.stress(f))
    assert torch.equal(law.project(f, 1e-3), again.project(f, 1e-3))
    assert law.description() == again.description()


@pytest.mark.slow
@pytest.mark.usefixtures("taichi")
def test_fit_of_an_adapter_improves_on_its_base_and_resumes(tmp_path):
    class Stop(Exception):
        pass

    def stop_late(stage, done, total, note=""):
        if stage == "identify: fit" and done == 2:
            raise Stop

    # A body that yields, which no elastic law does.
    seen = noisy(ClassicalLaw("von_mises", youngs_modulus=1e5, poissons_ratio=0.3, yield_stress=2e3))
    config = IdentifyConfig(
        law="adapter",
        contact="sticky",
        search_particles=200,
        samples_per_frame=1,
        adapter_base="neo_hookean",
        family_rollouts=12,
        iterations=4,
        pictures=0,
    )
    whole = identify(scene(), seen, config, SMALL)
    assert whole.law.kind == "adapter"
    assert whole.fit["trajectory_error_mm"] <= whole.fit["classical_error_mm"] + 0.1
    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(scene(), seen, config, SMALL, checkpoint=Checkpoint(path, every_s=0), progress=stop_late)
    resumed = identify(scene(), seen, config, SMALL, checkpoint=Checkpoint(path, every_s=0))
    assert whole.fit == resumed.fit
    for name, value in whole.law.state_dict().items():
        assert torch.equal(value, resumed.law.state_dict()[name])


@pytest.mark.usefixtures("taichi")
def test_gradient_of_a_rollout_with_an_adapter_equals_finite_differences():
    law = adapter("non_newtonian", seed=2)
    axis = (torch.arange(4, dtype=F64) + 0.5) / 10
    start = at_rest(torch.cartesian_prod(axis, axis + 0.02, axis), torch.tensor([0.2, -2.0, 0.1], dtype=F64),
                    torch.zeros(64, 3, 3, dtype=F64))  # fmt: skip
    start = State(start.position, start.velocity.expand(64, 3), start.affine_velocity, start.trial_gradient)
    sim = Simulator(particle_count=64, spacing=0.1, substep=1e-3, volume=0.064, density=1000.0, gravity=(0, -9.8, 0),
                    dtype=F64, max_substeps=SUBSTEPS, grid_nodes=NODES)  # fmt: skip

    def loss():
        return rollout(sim, law, start, 40, [20, 40]).pow(2).sum()

    loss().backward()
    weight = law.up.weight
    slope = float(weight.grad[0, 0])
    with torch.no_grad():
        values = []
        for step in (1e-4, -1e-4):
            weight[0, 0] += step
            values.append(float(loss()))
            weight[0, 0] -= step
    assert slope == pytest.approx((values[0] - values[1]) / 2e-4, rel=1e-3)
