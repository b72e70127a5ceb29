"""Each effect in a case whose answer is known on paper. A uniform motion in free flight is exact in MPM."""

import math

import numpy as np
import pytest
import torch
from effect_cases import DT, F64, LAW, WEIGHTLESS, body, last_velocity, run, setting, simulator
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.smooth_force import GRADIENT_SPLINES, SPLINES, STRENGTHS, acceleration
from masiv.materials.classical import ClassicalLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout

G = 9.8


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


def test_linear_drag_decays_exponentially():
    v = last_velocity(run("linear_drag", [3.0], 100, velocity=(2.0, 0, 1.0), gravity=WEIGHTLESS))
    np.testing.assert_allclose(v, np.array([2.0, 0, 1.0]) * math.exp(-0.3), atol=1e-9)


def test_quadratic_drag_decays_as_one_over_time_and_has_a_terminal_velocity():
    v = last_velocity(run("quadratic_drag", [3.0], 100, velocity=(2.0, 0, 1.5), gravity=WEIGHTLESS))
    np.testing.assert_allclose(v, np.array([2.0, 0, 1.5]) / (1 + 3.0 * 2.5 * 0.1), atol=1e-9)
    fall = last_velocity(run("quadratic_drag", [5.0], 300))
    assert fall[1] == pytest.approx(-math.sqrt(G / 5.0) * math.tanh(0.3 * math.sqrt(5.0 * G)), rel=5e-3)


def test_gravity_scale_and_body_force_add_to_gravity():
    fall = last_velocity(run("gravity_scale", [-0.25], 80))
    np.testing.assert_allclose(fall, [0, -0.75 * G * 0.08, 0], atol=1e-9)
    pushed = last_velocity(run("body_force", [1.0, 2.0, -3.0], 80))
    np.testing.assert_allclose(pushed, [0.08, (2.0 - G) * 0.08, -0.24], atol=1e-9)


def test_periodic_force_gives_the_impulse_of_its_integral():
    a, b, omega, t = np.array([5.0, 0, 1.0]), np.array([0, 4.0, -2.0]), 2 * math.pi * 3.0, 0.13
    v = last_velocity(run("periodic_force", [*a, *b, 3.0], 130, gravity=WEIGHTLESS))
    np.testing.assert_allclose(v, a * math.sin(omega * t) / omega + b * (1 - math.cos(omega * t)) / omega, atol=1e-4)


def test_swirl_spins_up_and_carries_round():
    x = body(height=5.0)
    middle, axis = x.mean(0), x.mean(0) + torch.tensor([0.4, 0.0, 0.0], dtype=F64)
    positions = run("swirl", [6.0, axis[0].item(), axis[2].item()], 60, x=x, gravity=WEIGHTLESS)
    v, t = (positions[-1] - positions[-2]) / DT, 0.06
    # up x (x - c), with x - c = (-0.4, 0, 0), is (0, 0, 0.4)
    np.testing.assert_allclose(v.mean(0).numpy(), [0, 0, 6.0 * 0.4 * t], atol=2e-3)
    arm = x - middle
    momentum = (arm[:, 2] * v[:, 0] - arm[:, 0] * v[:, 2]).sum()
    assert (momentum / (arm[:, 0] ** 2 + arm[:, 2] ** 2).sum()).item() == pytest.approx(6.0 * t, rel=0.02)


def test_drag_crisis_is_quadratic_drag_below_and_above_it_and_follows_its_curve_between():
    below, above, critical = 2.0, 0.3, 3.0
    for speed, coefficient in ((0.8, below), (12.0, above)):
        v = last_velocity(run("drag_crisis", [below, above, critical], 50, velocity=(speed, 0, 0), gravity=WEIGHTLESS))
        assert v[0] == pytest.approx(speed / (1 + coefficient * speed * 50 * DT), rel=2e-3)

    def slowed(_, v):
        s = (v / critical) ** 8
        return -(below + (above - below) * s / (1 + s)) * v**2

    v = last_velocity(run("drag_crisis", [below, above, critical], 200, velocity=(4.0, 0, 0), gravity=WEIGHTLESS))
    known = solve_ivp(slowed, (0, 200 * DT), [4.0], rtol=1e-10, atol=1e-10).y[0, -1]
    assert v[0] == pytest.approx(known, rel=5e-3)  # of the first order in the substep


def test_magnus_turns_the_velocity_about_the_spin_and_keeps_the_speed():
    """v' = k x v has the solution v(t) = exp(t [k]x) v(0): a rotation by |k| t about k."""
    k, v, t = np.array([1.0, -3.0, 2.0]), np.array([2.0, 0.5, 1.0]), 0.1
    last = last_velocity(run("magnus", k.tolist(), 100, velocity=tuple(v), gravity=WEIGHTLESS))
    np.testing.assert_allclose(last, Rotation.from_rotvec(k * t).apply(v), atol=1e-5)
    assert np.linalg.norm(last) == pytest.approx(np.linalg.norm(v), abs=1e-9)


def test_magnus_leaves_the_spin_of_a_body_that_spins_along_it():
    """What k x (omega x r) does to the parts of the body sums to no torque."""
    x = body(height=5.0)
    omega = (0.0, 6.0, 0.0)
    spun, plain = (
        run(name, [0.0, 3.0, 0.0], 60, x=x, velocity=(2.0, 0.0, 0.0), omega=omega, gravity=WEIGHTLESS)
        for name in ("magnus", None)
    )
    spins = []
    for positions in (spun, plain):
        arm = (positions[-1] - positions[-1].mean(0)).numpy()
        v = ((positions[-1] - positions[-2]) / DT).numpy()
        spins.append(np.cross(arm, v - v.mean(0)).sum(0) / (arm[:, [0, 2]] ** 2).sum())
    np.testing.assert_allclose(spins[0], spins[1], atol=0.02 * omega[1])


def test_point_mass_adds_what_it_says_and_moves_the_centre_of_mass():
    x = body(height=5.0)
    place, omega = torch.tensor([0.2, 5.1, 0.1], dtype=F64), torch.tensor([0, 0, 4.0], dtype=F64)
    theta = torch.tensor([3.0, *place], dtype=F64)
    effect, known = effects()["point_mass"], setting(x)
    mass = known.particle_mass * effect.mass_factor(theta, known)
    assert mass.sum().item() == pytest.approx(8.0 + 3.0, abs=1e-9)
    outside = effect.mass_factor(torch.tensor([3.0, 50.0, 0, 0], dtype=F64), known)
    assert known.particle_mass * outside.sum().item() == pytest.approx(11.0, abs=1e-9)
    # No force acts: the centre of mass, and no other point, keeps the velocity that it was thrown with.
    share = (mass / mass.sum())[:, None]
    centre = (share * x).sum(0)
    positions = run("point_mass", theta.tolist(), 60, x=x, omega=omega.tolist(), gravity=WEIGHTLESS)
    expected = torch.linalg.cross(omega, centre - x.mean(0)) * 60 * DT
    assert expected.norm() > 3e-3
    torch.testing.assert_close((share * positions[-1]).sum(0) - centre, expected, rtol=0, atol=1e-9)


def test_mass_is_at_its_place_inside_and_in_the_outermost_layer_at_a_face():
    x = body(height=5.0)
    effect, known = effects()["point_mass"], setting(x)
    for place in ([0.1, 5.1, 0.1], [0.13, 5.06, 0.12], [0.17, 5.1, 0.04]):
        added = effect.mass_factor(torch.tensor([2.0, *place], dtype=F64), known) - 1
        assert known.particle_mass * added.sum().item() == pytest.approx(2.0, rel=1e-9)
        np.testing.assert_allclose((added[:, None] * x).sum(0) / added.sum(), place, atol=1e-4)
    lattice = torch.cartesian_prod(*[torch.arange(0.005, 0.2, 0.01, dtype=F64)] * 3)
    known = setting(lattice)
    added = effect.mass_factor(torch.tensor([2.0, 0.1, 0.195, 0.1], dtype=F64), known) - 1
    middle = (added[:, None] * lattice).sum(0) / added.sum()
    # a Gaussian of radius 0.025 cut in two would be at 0.175
    np.testing.assert_allclose(middle, [0.1, 0.192, 0.1], atol=2e-3)
    assert added.max() < 0.05 * added.sum()


def test_point_force_moves_the_whole_as_its_sum_and_turns_it_about_its_middle():
    x, force = body(height=5.0), torch.tensor([4.0, 0.0, 2.0], dtype=F64)
    place = torch.tensor([0.1, 5.15, 0.1], dtype=F64)
    positions = run("point_force", [*force.tolist(), *place.tolist()], 50, x=x, gravity=WEIGHTLESS)
    mass, t = 8.0, 0.05
    np.testing.assert_allclose(last_velocity(positions), (force * t / mass).numpy(), rtol=0.03, atol=1e-9)
    spin = torch.linalg.cross(positions[-1] - positions[-1].mean(0), (positions[-1] - positions[-2]) / DT).sum(0)
    expected = torch.linalg.cross(place - x.mean(0), force) * t / (mass / len(x))
    np.testing.assert_allclose(spin.numpy(), expected.numpy(), rtol=0.05, atol=2.0)


def test_point_force_on_a_heavier_body_moves_it_less():
    x = body(height=5.0)
    kind = {"gravity": torch.zeros(3)}
    members = tuple(
        (effects()[n], torch.tensor(v, dtype=F64))
        for n, v in (("point_mass", [8.0, 0.1, 5.1, 0.1]), ("point_force", [4.0, 0, 0, 0.1, 5.1, 0.1]))
    )
    active = ActiveEffects(members, setting(x))
    moved = rollout(
        simulator(len(x), **kind), LAW, rigid_initial_state(x, *torch.zeros(2, 3, dtype=F64)), 40, [39, 40], active
    )
    share = (active.mass_factor() / active.mass_factor().sum())[:, None]
    velocity = (share * (moved[-1] - moved[-2]) / DT).sum(0)
    np.testing.assert_allclose(velocity.numpy(), [4.0 * 0.04 / 16.0, 0, 0], rtol=0.03, atol=1e-9)


def test_hidden_obstacle_stops_a_body_at_its_surface():
    x = body(height=5.0)
    centre, radius = torch.tensor([0.1, 4.65, 0.1], dtype=F64), 0.3
    kind = {"x": x, "velocity": (0, -1.5, 0), "gravity": WEIGHTLESS}
    through = run(None, None, 250, **kind)[-1]
    assert ((through - centre).norm(dim=1) < radius).float().mean() > 0.9
    stopped = run("hidden_obstacle", [radius, *centre.tolist()], 250, **kind, outputs=list(range(0, 251, 10)))
    distance = (stopped - centre).norm(dim=2)
    assert distance.min() > radius - 0.05  # a cell
    assert distance[:, x[:, 1].argmin()].min() < radius + 0.05
    assert (stopped[-1] - stopped[-2]).mean(0)[1] > 0  # and it bounces


@pytest.mark.parametrize("slipperiness", [3.0, 5.0])
def test_ground_friction_is_coulombs(slipperiness):
    """While it slides, the ground takes mu times as much sideways as it gives upwards, until it stops."""
    mu, v, x = 1 / slipperiness, 0.8, body(height=0.0)
    outputs = [*range(59, 601, 60), *range(60, 601, 60)]
    stiff = ClassicalLaw("neo_hookean", youngs_modulus=2e5, poissons_ratio=0.3)
    positions = run("ground_friction", [slipperiness], 600, x=x, velocity=(v, 0, 0), contact="release", law=stiff,
                    outputs=sorted(outputs))  # fmt: skip
    speed = ((positions[1::2] - positions[::2]) / DT).mean(1)
    sideways = v - speed[0, 0].item()
    upwards = speed[0, 1].item() + G * 60 * DT
    assert sideways / upwards == pytest.approx(mu, rel=0.02)
    slid = (positions[-1] - x).mean(0)[0].item()
    assert slid == pytest.approx(v * v / (2 * mu * G), rel=0.03)


def test_ground_friction_agrees_with_the_simulators_slip():
    kind = {"x": body(), "velocity": (1.0, -2.0, 0.5), "omega": (2.0, 1.0, -3.0)}
    slip = run(None, None, 150, contact="slip", friction=0.3, **kind)
    effect = run("ground_friction", [1 / 0.3], 150, contact="release", **kind)
    torch.testing.assert_close(effect, slip, rtol=0, atol=1e-9)


@pytest.mark.parametrize("e", [0.3, 0.8])
def test_restitution_bounces_to_e_squared_of_the_height(e):
    """Loose matter, all of it at the ground: thrown back at e v, it climbs to e^2 of the height that it fell from."""
    x, v, steps = body(height=-0.3), 2.0, 170
    dust = ClassicalLaw("neo_hookean", youngs_modulus=1e-3, poissons_ratio=0.3)
    height = run("restitution", [e], steps, x=x, velocity=(0, -v, 0), law=dust, contact="release",
                 outputs=list(range(1, steps + 1)))[:, :, 1].mean(1)  # fmt: skip
    first = (height[0] - x[:, 1].mean()).item() / DT
    assert first == pytest.approx(e * (v + G * DT), rel=1e-9)
    climbed = (height.max() - height[0]).item()
    assert climbed == pytest.approx(e * e * v * v / (2 * G), rel=0.03)


def test_restitution_frees_what_sticky_ground_keeps():
    """e = 1 on sticky ground: a body thrown down leaves the ground again, which otherwise keeps it."""
    kind = {"x": body(), "velocity": (0, -2.0, 0), "contact": "sticky"}
    kept, freed = (run("restitution", [e], 200, **kind)[-1][:, 1] for e in (0.0, 1.0))
    assert kept.min() < 0.03
    assert freed.min() > 0.1


def test_a_force_is_periodic_when_it_has_come_round():
    shaken = effects()["periodic_force"]
    theta = torch.tensor([1.0, 0, 0, 0, 0, 0, 2.0])
    assert shaken.hints.identifiability_issue(theta, 0.6, torch.zeros(1, 3)) is None
    assert "no whole period of 2 Hz" in shaken.hints.identifiability_issue(theta, 0.4, torch.zeros(1, 3))
    assert effects()["linear_drag"].hints.identifiability_issue(torch.tensor([1.0]), 0.01, torch.zeros(1, 3)) is None


def test_a_swirl_far_from_its_axis_is_a_uniform_force():
    random = np.random.default_rng(0)
    places = torch.tensor(random.uniform((0.1, 0.3, -0.2), (0.5, 0.7, 0.2), (200, 3)))  # 0.16 m about their mean
    swirl = effects()["swirl"]
    assert swirl.hints.identifiability_issue(torch.tensor([6.0, 0.0, 0.0]), 0.5, places) is None
    assert "no more than a uniform force" in swirl.hints.identifiability_issue(
        torch.tensor([0.6, 0.3, -1.0]), 0.5, places
    )


@torch.enable_grad()
def test_ground_height_and_time_offset_hand_their_shift_to_the_caller():
    x = body()
    thetas = [("ground_height", 0.02), ("time_offset", -0.004), ("linear_drag", 1.0)]
    active = ActiveEffects(
        tuple((effects()[n], torch.tensor([v], dtype=F64, requires_grad=True)) for n, v in thetas), setting(x)
    )
    assert active.ground_shift().item() == pytest.approx(0.02)
    assert active.time_shift().item() == pytest.approx(-0.004)
    (active.ground_shift() + 2 * active.time_shift()).backward()
    assert [theta.grad.item() if theta.grad is not None else None for _, theta in active.members] == [1.0, 2.0, None]


def test_smooth_force_is_the_field_that_it_is_said_to_be():
    """Velocity of the mean: the integral of the field over time, constant after its span, mean over the body."""
    theta = np.zeros(STRENGTHS + 4)
    random = np.random.default_rng(5)
    theta[:STRENGTHS] = random.normal(size=STRENGTHS) * np.where(np.arange(STRENGTHS) < 3 * SPLINES, 10.0, 5.0)
    theta[STRENGTHS:] = 0.12, 0.3, 4.8, -0.2
    steps = 150
    x = run("smooth_force", theta.tolist(), steps, gravity=WEIGHTLESS, outputs=list(range(1, steps + 1)))
    places = torch.cat([body(height=5.0)[None], x]).numpy()
    field = acceleration(theta, places[:-1], DT * np.arange(steps)).mean(1)
    velocity = np.diff(places, axis=0).mean(1) / DT
    np.testing.assert_allclose(velocity, DT * np.cumsum(field, axis=0), atol=2e-3 * np.abs(velocity).max())


def test_smooth_force_can_change_linearly_in_time():
    """Splines reproduce a straight line between its ends, and stay at its end."""
    theta = np.zeros(STRENGTHS + 4)
    theta[: 3 * SPLINES : 3] = (np.arange(SPLINES) - 0.5) / (SPLINES - 2)
    theta[STRENGTHS] = 2.0
    times = np.array([0.0, 0.3, 1.0, 1.9, 2.0, 3.0])
    found = acceleration(theta, np.zeros((len(times), 1, 3)), times)[:, 0]
    np.testing.assert_allclose(found, np.outer(np.minimum(times / 2, 1.0), [1, 0, 0]), atol=1e-12)
    theta[:] = 0.0
    turn = np.array([[0.0, 3.0, 0.0], [0.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])  # what acts along a row, by a place's column
    theta[3 * SPLINES : STRENGTHS] = np.tile(turn.T.ravel(), GRADIENT_SPLINES)
    theta[STRENGTHS:] = 2.0, 0.1, 0.2, 0.3
    place = np.array([0.5, -0.5, 1.0])
    found = acceleration(theta, np.broadcast_to(place, (len(times), 1, 3)), times)[:, 0]
    np.testing.assert_allclose(found, np.tile(turn @ (place - theta[-3:]), (len(times), 1)), atol=1e-12)
