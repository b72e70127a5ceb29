"""Situations that were never filmed: forces, other laws, bodies and grounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from small import NODES, SMALL, SUBSTEPS

from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.materials.blend import BlendedLaw, blend
from masiv.materials.classical import ClassicalLaw
from masiv.materials.load import load_law
from masiv.materials.neural import strain_invariants
from masiv.mpm.simulator import Simulator
from masiv.pretraining.pretrain import pretrained_path
from masiv.report.film import balls
from masiv.scene.scene import Ground
from masiv.simulation.force import ForcePulse
from masiv.simulation.simulate import simulate
from masiv.simulation.variation import with_body_of, with_density, with_ground, with_mesh
from masiv.twin import Twin

pytestmark = pytest.mark.usefixtures("taichi")
SIDE, FPS = 0.3, 24.0
GRAVITY = np.array([0.0, -9.8, 0.0])


def twin(law=None, up=(0.0, 1.0, 0.0), **changes):
    axis = (np.arange(6) + 0.5) / 6 * SIDE
    cube = np.stack(np.meshgrid(axis, axis + 0.2, axis, indexing="ij"), -1).reshape(-1, 3)
    up = np.array(up)
    settings = dict(
        positions=cube.astype(np.float32), velocity=np.array([0.4, 0.5, 0.0]), omega=np.zeros(3), gravity=GRAVITY,
        ground=Ground(up, 0.0), contact="sticky", friction=0.0, volume=SIDE**3, density=1000.0, up=up, fps=FPS,
        law=law or ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3),
        simulator=SMALL,
    )  # fmt: skip
    return Twin.of_body(**(settings | changes))


def neural(material):
    return load_law(pretrained_path(material))


# ---- forces --------------------------------------------------------------------------------------------------------


def test_a_force_gives_its_exact_impulse_to_free_flight():
    """From 0.01 to 0.1 s, neither on a frame nor a multiple of a substep: v rises by F t / m and nothing else moves."""
    flying = twin(gravity=np.zeros(3), ground=None, contact="none")
    mass = flying.density * flying.volume
    force = np.array([30.0, -12.0, 45.0])
    positions = simulate(flying, frames=6, force=ForcePulse(force, 0.01, 0.1)).positions.astype(np.float64)
    steps = np.diff(positions.mean(1), axis=0) * FPS
    np.testing.assert_allclose(steps[3:], np.broadcast_to(flying.velocity + force * 0.09 / mass, (2, 3)), atol=2e-5)
    # Before its end the body moves as a constant acceleration moves it, to first order in the substep (a ninth of it).
    pushed = positions[1].mean(0) - positions[0].mean(0) - flying.velocity / FPS
    np.testing.assert_allclose(pushed, 0.5 * force / mass * (1 / FPS - 0.01) ** 2, rtol=0.15)
    np.testing.assert_allclose(np.ptp(positions[5] - positions[0], axis=0), 0, atol=2e-5)  # uniform: no strain


def test_a_force_of_minus_the_weight_is_weightlessness():
    body = twin(up=(0.0, 0.0, 1.0), gravity=np.array([0, 0, -9.8]), ground=None, contact="none")
    held = simulate(body, frames=4, force=ForcePulse(np.array([0, 0, 9.8 * 1000 * SIDE**3]))).positions
    floating = simulate(replace(body, gravity=np.zeros(3)), frames=4).positions
    np.testing.assert_allclose(held, floating, atol=1e-6)


def test_a_force_is_cut_at_its_ends_and_not_at_frames():
    push = ForcePulse(np.ones(3), 0.01, 0.03)
    assert push.pieces(0.0, 0.04) == [(0.01, False), (pytest.approx(0.02), True), (pytest.approx(0.01), False)]
    assert push.pieces(0.01, 0.03) == [(pytest.approx(0.02), True)]
    assert push.pieces(0.03, 0.05) == [(pytest.approx(0.02), False)]
    assert ForcePulse(np.ones(3), 0.01, 0.03 + 1e-12).pieces(0.03, 0.05) == [(pytest.approx(0.02), False)]


def test_divergence_names_the_substep_from_the_start():
    blow = ForcePulse(np.array([1e7, 0.0, 0.0]), start=2 / FPS)
    flying = twin(gravity=np.zeros(3), ground=None, contact="none")
    with pytest.raises(NonFiniteError) as caught:
        simulate(flying, frames=6, substeps=10, force=blow)
    assert 20 <= caught.value.substep < 30
    assert f"substep {caught.value.substep}" in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ForcePulse(np.array([1.0, np.nan, 0])), "--force takes"),
        (lambda: ForcePulse(np.ones(3), -0.1), "--force-from"),
        (lambda: ForcePulse(np.ones(3), 0.2, 0.1), "--force-until"),
        (lambda: simulate(twin(), frames=3, force=ForcePulse(np.ones(3), 0.2)), "last frame is at 0.0833"),
        (lambda: with_density(twin(), 0.0), "--density 0"),
        (lambda: with_ground(twin(), "low"), "--ground low"),
        (lambda: with_ground(twin(), "0.4"), "reaches down to"),
        (lambda: blend(neural("jelly"), neural("water"), 1.5), "--blend 1.5"),
        (lambda: blend(neural("jelly"), twin().law, 0.5), "neural law and a neo_hookean law"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


# ---- laws ----------------------------------------------------------------------------------------------------------


def gradients(count=40, size=0.2):
    generator = torch.Generator().manual_seed(3)
    return torch.eye(3, dtype=torch.float64) + size * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)


def rotations(count=40):
    q, r = torch.linalg.qr(gradients(count, 1.0))
    q = q * torch.sign(r.diagonal(dim1=1, dim2=2))[:, None]
    return q * torch.linalg.det(q)[:, None, None]


def test_the_ends_of_a_blend_are_the_two_laws():
    first, second = neural("jelly").double(), neural("plasticine").double()
    f, dt = gradients(), 1e-3
    assert blend(first, second, 0) is first
    assert blend(first, second, 1) is second
    for weight, law in ((0.0, first), (1.0, second)):
        end = BlendedLaw(first, second, weight)
        torch.testing.assert_close(end.project(f, dt), law.project(f, dt), rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(end.stress(f), law.stress(f), rtol=1e-9, atol=1e-6)
        assert end.wave_modulus() == pytest.approx(law.wave_modulus())


def test_a_blend_keeps_what_a_law_guarantees():
    law = BlendedLaw(neural("jelly").double(), neural("plasticine").double(), 0.4)
    f, turn, dt = gradients(), rotations(), 1e-3
    eye = torch.eye(3, dtype=torch.float64)[None]
    assert float(law.stress(eye).detach().abs().max()) == 0
    torch.testing.assert_close(law.project(eye, dt), eye, rtol=0, atol=1e-14)
    torch.testing.assert_close(law.stress(turn @ f), turn @ law.stress(f) @ turn.mT, rtol=1e-8, atol=1e-4)
    torch.testing.assert_close(law.stress(f @ turn), law.stress(f), rtol=1e-8, atol=1e-4)
    torch.testing.assert_close(law.project(turn @ f, dt), turn @ law.project(f, dt), rtol=1e-8, atol=1e-9)
    stiffness = [end.wave_modulus() for end in (law.first, law.second, law)]
    assert stiffness[2] == pytest.approx(0.6 * stiffness[0] + 0.4 * stiffness[1])
    share = law.flow_share(strain_invariants(f), dt)
    ends = [end.flow_share(strain_invariants(f), dt) for end in (law.first, law.second)]
    assert (share >= torch.minimum(*ends) - 1e-12).all()
    assert (share <= torch.maximum(*ends) + 1e-12).all()


def test_a_blend_does_not_depend_on_the_substep():
    law = BlendedLaw(neural("jelly").double(), neural("plasticine").double(), 0.5)
    f = gradients(size=0.02)
    once, twice = law.project(f, 2e-5), law.project(law.project(f, 1e-5), 1e-5)
    moved = (law.project(f, 2e-5) - f).norm()
    assert float((once - twice).detach().norm()) < 0.05 * float(moved.detach())


def test_a_blend_rolls_out_as_its_definition_and_between_its_ends():
    jelly, water = neural("jelly"), neural("water")

    def run(law):
        return simulate(twin(law, velocity=np.array([0, -2.0, 0])), frames=5).positions

    ends = [run(law) for law in (jelly, water)]
    np.testing.assert_allclose(run(BlendedLaw(jelly, water, 0.0)), ends[0], atol=2e-4)
    # The flattest that each gets: later they rebound, the softer the later.
    height = [np.ptp(p[..., 1], axis=1).min() for p in (*ends, run(blend(jelly, water, 0.5)))]
    assert height[1] < height[2] < height[0]
    with pytest.raises(MasivError, match="no adjoint"):
        BlendedLaw(jelly, water, 0.5).bind(simulator().kernels, 8, 1e-3).backward(0, 8)


def simulator():
    return Simulator(
        particle_count=216, spacing=0.1, substep=1e-3, volume=0.027, density=1e3, gravity=GRAVITY,
        max_substeps=SUBSTEPS, grid_nodes=NODES,
    )  # fmt: skip


def test_classical_laws_of_one_kind_blend_their_parameters():
    ends = [ClassicalLaw("von_mises", youngs_modulus=e, poissons_ratio=n, yield_stress=y)
            for e, n, y in ((1e4, -0.1, 100.0), (4e4, 0.3, 900.0))]  # fmt: skip
    values = {name: float(value) for name, value in blend(*ends, 0.5).values.items()}
    assert values == pytest.approx({"youngs_modulus": 2e4, "poissons_ratio": 0.1, "yield_stress": 300.0})


# ---- bodies, densities, grounds ------------------------------------------------------------------------------------


def test_a_mesh_keeps_mass_size_and_place(tmp_path):
    path = tmp_path / "ball.obj"
    trimesh.creation.icosphere(subdivisions=3, radius=40.0).export(path)  # in millimetres, say
    body = twin(up=(0.0, 0.0, 1.0), simulator=SMALL.model_copy(update={"subparticles": 4}))
    ball = with_density(with_mesh(body, path), 700.0)
    true = np.pi / 6 * np.ptp(body.positions, axis=0).max() ** 3  # a ball as wide as the cube's outer points
    assert ball.volume == pytest.approx(true, rel=0.03)
    assert len(ball.positions) == pytest.approx(len(body.positions), rel=0.1)
    assert ball.density * ball.volume == pytest.approx(700 * true, rel=0.03)
    assert ball.positions[:, 2].min() == pytest.approx(body.positions[:, 2].min(), abs=1e-6)
    middle = [0.5 * (p.min(0) + p.max(0))[:2] for p in (ball.positions, body.positions)]
    np.testing.assert_allclose(*middle, atol=1e-6)
    motion = simulate(ball, frames=3).positions
    assert motion.shape == (3, 4 * len(ball.positions), 3)  # in parts
    drawn = balls(ball.positions, ball.volume)
    assert len(drawn) == len(ball.positions)
    assert len(np.unique(drawn.colours.numpy(), axis=0)) == 2


def test_a_mesh_that_is_open_is_refused(tmp_path):
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(tmp_path / "open.obj")
    with pytest.raises(InputError, match="not watertight"):
        with_mesh(twin(), tmp_path / "open.obj")


def test_the_body_of_another_run_keeps_its_size():
    other = twin(volume=0.001, density=400.0)
    other = other.with_body(particles=(0.2 * other.positions + 3).astype(np.float32))
    moved, shift = with_body_of(twin(), other)
    np.testing.assert_allclose(moved.positions, other.positions + shift, atol=1e-6)
    assert moved.volume == 0.001
    assert moved.density == 1000.0
    assert moved.positions[:, 1].min() == pytest.approx(twin().positions[:, 1].min(), abs=1e-6)


def test_density_changes_mass_and_not_flight_and_ground_is_where_it_is_put():
    light = simulate(with_density(twin(), 250.0), frames=3).positions
    heavy = simulate(twin(), frames=3).positions
    np.testing.assert_allclose(light.mean(1), heavy.mean(1), atol=2e-3)  # in the air so far
    free = simulate(with_ground(twin(), "none"), frames=12).positions
    assert free[-1][:, 1].min() < -0.2
    low = simulate(with_ground(twin(), "-0.1"), frames=12).positions
    assert -0.15 < low[-1][:, 1].min() < -0.01
    raised = with_ground(twin(ground=None, contact="none"), "0.1")
    assert raised.contact == "sticky"
    assert simulate(raised, frames=12).positions[-1][:, 1].min() > 0.05
