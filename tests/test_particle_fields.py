"""Stress, strain and accelerations along a rollout, against solutions on paper."""

import numpy as np
import pytest
import torch
from small import SMALL

from masiv.materials.classical import ClassicalLaw
from masiv.materials.measures import deviatoric_strain, von_mises_stress
from masiv.scene.scene import Ground
from masiv.simulation.particle_fields import ParticleFields
from masiv.simulation.simulate import simulate
from masiv.tracks.placement import Placement
from masiv.twin import Body, Boundary, InitialCondition, Twin, TwinEffect

pytestmark = pytest.mark.usefixtures("taichi")
SIDE, FPS, FRAMES = 0.3, 24.0, 5
UP = np.array([0.0, 0.0, 1.0])  # not the simulator's: vectors are turned
VELOCITY = np.array([0.4, -0.6, 0.5])


def twin(effects=(), **changes):
    axis = (np.arange(6) + 0.5) / 6 * SIDE
    cube = np.stack(np.meshgrid(axis, axis, axis + 3, indexing="ij"), -1).reshape(-1, 3)
    settings = dict(
        positions=cube.astype(np.float32), velocity=VELOCITY, omega=np.zeros(3), gravity=-9.8 * UP,
        ground=Ground(UP, 0.0), contact="sticky", volume=SIDE**3, density=1000.0, up=UP, fps=FPS,
        law=ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3), simulator=SMALL,
        effects=tuple(effects),
    )  # fmt: skip
    return Twin.of_body(**(settings | changes))


def test_a_bar_under_tension_has_its_axial_stress():
    """Neo-Hookean, stretched by a along x and by b across it: tau_x - tau_y = mu (a² - b²), J = a b²."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=2.6e4, poissons_ratio=0.3)
    a, b = 1.2, 0.9
    gradient = torch.diag(torch.tensor([a, b, b], dtype=torch.float64))[None]
    expected = 1e4 * (a**2 - b**2) / (a * b**2)
    with torch.no_grad():
        assert float(von_mises_stress(law.stress(gradient), gradient)) == pytest.approx(expected)
    assert float(deviatoric_strain(gradient)) == pytest.approx(2 / 3 * np.log(a / b))


def test_free_flight_is_free_of_stress_and_the_fields_change_no_position():
    rollout = simulate(twin(), frames=FRAMES, fields=True)
    fields = rollout.fields
    assert fields is not None and fields.stress is not None and fields.strain is not None  # noqa: PT018
    assert fields.stress.shape == fields.strain.shape == rollout.positions.shape[:2]
    assert fields.stress.max() < 1.0  # Pa, rounding: the modulus is 20 kPa
    assert fields.strain.max() < 1e-4
    assert fields.accelerations == {}
    np.testing.assert_array_equal(rollout.positions, simulate(twin(), frames=FRAMES).positions)


def test_a_body_that_stands_carries_its_weight():
    """A slab that has come to rest: the mean of the vertical stress over the body is that of a column, rho g h / 2.
    A law without Poisson's ratio has no stress across it, so this is the von Mises stress."""
    axis = (np.arange(8) + 0.5) / 8 * 0.4
    slab = np.stack(np.meshgrid(axis, axis, (np.arange(4) + 0.5) / 8 * 0.4, indexing="ij"), -1).reshape(-1, 3)
    law = ClassicalLaw("neo_hookean", youngs_modulus=5e4, poissons_ratio=0.01)
    damped = [TwinEffect("viscosity", {"viscosity": 200.0})]
    standing = twin(damped, positions=slab.astype(np.float32), volume=0.4 * 0.4 * 0.2, law=law, velocity=np.zeros(3))
    rollout = simulate(standing, frames=25, fields=True)
    assert rollout.fields is not None and rollout.fields.stress is not None  # noqa: PT018
    assert rollout.fields.stress[-1].mean() == pytest.approx(1000 * 9.8 * 0.1, rel=0.15)


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (TwinEffect("linear_drag", {"rate": 0.8}), lambda v: -0.8 * v),
        (
            TwinEffect("body_force", {f"acceleration_{a}": v for a, v in zip("xyz", (1.5, -2.0, 0.5), strict=True)}),
            lambda v: np.broadcast_to([1.5, -0.5, -2.0], v.shape),  # simulation (x, y, z) is world (x, z, -y)
        ),
    ],
)
def test_an_effect_gives_its_acceleration(effect, expected):
    effects = [effect, TwinEffect("ground_height", {"height": 0.01})]
    rollout = simulate(twin(effects), frames=FRAMES, fields=True)
    assert rollout.fields is not None
    assert set(rollout.fields.accelerations) == {effect.name}  # another height of the ground is no acceleration
    velocity = np.gradient(rollout.positions.astype(np.float64).mean(1), 1 / FPS, axis=0)[1:-1]
    found = rollout.fields.accelerations[effect.name][1:-1]
    np.testing.assert_allclose(found, np.broadcast_to(expected(velocity)[:, None], found.shape), atol=0.03)


def test_frames_of_a_late_clock_lie_between_states():
    fields = ParticleFields(np.array([[0.0], [2], [6]]), None, {"wind": np.arange(9.0).reshape(3, 1, 3)})
    late = fields.at(np.array([0, 1.25, 2]))
    assert late.stress is not None
    np.testing.assert_allclose(late.stress[:, 0], [0, 3, 6])
    np.testing.assert_allclose(late.accelerations["wind"][1, 0], [3.75, 4.75, 5.75])
    shifted = simulate(twin([TwinEffect("time_offset", {"delay": 0.4 / FPS})]), frames=3, fields=True)
    assert shifted.fields is not None and shifted.fields.stress is not None  # noqa: PT018
    assert shifted.fields.stress.shape == shifted.positions.shape[:2]


def test_drag_of_a_flight_is_what_its_speed_makes_it():
    from masiv.effects.per_body import DragBody

    ball = Body("ball", 1e-4, 500.0, drag=DragBody(0.06, 0.05, 1.2, 1.8e-5))
    start = InitialCondition("drop", "ball", 30.0, VELOCITY, np.zeros(3), placement=Placement(np.eye(3), UP * 9))
    flying = Twin(
        (ball,), Boundary(), -9.8 * UP, UP, (start,), SMALL, (TwinEffect("linear_drag", {"rate": 0.5}),)
    )  # fmt: skip
    rollout = simulate(flying, frames=10, fields=True)
    assert rollout.fields is not None
    assert rollout.fields.stress is None
    times = rollout.times[:, None]
    end = -9.8 * UP / 0.5  # v = end + (v0 - end) e^-kt
    velocity = end + (VELOCITY - end) * np.exp(-0.5 * times)
    np.testing.assert_allclose(rollout.fields.accelerations["linear_drag"][:, 0], -0.5 * velocity, atol=1e-3)
