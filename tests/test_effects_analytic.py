"""Each effect in a case whose answer is known on paper. A uniform motion in free flight is exact in MPM."""

import math

import numpy as np
import pytest
import taichi as ti
import torch
from effect_cases import DT, F64, LAW, body, setting, simulator
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.directions import direction, inclination_of
from masiv.effects.smooth_force import GRADIENT_SPLINES, SPLINES, STRENGTHS, acceleration
from masiv.materials.classical import ClassicalLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.state import State

WEIGHTLESS = (0.0, 0.0, 0.0)
G = 9.8


def run(name, theta, steps, *, x=None, velocity=(0, 0, 0), omega=(0, 0, 0), outputs=None, law=LAW, state=None, **kind):
    """Positions (K, N, 3) at the substeps ``outputs``, the last two by default, of a body far above ground."""
    x = body(height=5.0) if x is None else x
    state = (
        rigid_initial_state(x, torch.tensor(velocity, dtype=F64), torch.tensor(omega, dtype=F64))
        if state is None
        else state
    )
    active = None
    if name is not None:
        active = ActiveEffects(((effects()[name], torch.tensor(theta, dtype=F64)),), setting(x))
    return rollout(simulator(len(x), **kind), law, state, steps, outputs or [steps - 1, steps], active)


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


def last_velocity(positions):
    """Mean (3,) over the particles in the last substep."""
    return ((positions[-1] - positions[-2]) / DT).mean(0).numpy()


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


def test_viscosity_damps_an_oscillation_at_the_rate_of_kelvin_and_voigt():
    """A mode that keeps volume has the complex shear modulus mu + i omega eta: it decays at omega^2 eta / (2 mu)."""
    x, mu, eta = body(height=5.0), 2e4 / 2 / 1.3, 12.0
    stretch = torch.diag(torch.tensor([1.0, -0.5, -0.5], dtype=F64)) * 0.5
    state = at_rest(x, (x - x.mean(0)) @ stretch.T, stretch.expand(len(x), 3, 3))
    outputs, arm = list(range(0, 241, 2)), (x - x.mean(0))[:, 0]
    free, damped = (
        (run(name, [eta], 240, x=x, state=state, gravity=WEIGHTLESS, outputs=outputs, law=LAW)[:, :, 0] * arm).sum(1)
        for name in (None, "viscosity")
    )
    free, damped = (q - q[0] for q in (free, damped))
    # the first extremum each way: half a period apart, and the ratio of the swings is the decay between them
    first, second = int(free[:60].argmax()), int(free.argmin())
    half_period = (second - first) * 2 * DT
    swing = [(q.max() - q.min()).item() for q in (free, damped)]
    omega = math.pi / half_period
    expected = omega**2 * eta / (2 * mu) * 0.5 * (first + second) * 2 * DT
    assert math.log(swing[0] / swing[1]) == pytest.approx(expected, rel=0.2)


def test_stiffness_contrast_everywhere_is_a_stiffer_law():
    x = body()
    kind = {"x": x, "velocity": (0.5, -2.0, 0.0)}
    stiffer = ClassicalLaw("neo_hookean", youngs_modulus=2e4 * math.exp(0.7), poissons_ratio=0.3)
    everywhere = run("stiffness_contrast", [0.7, *x.mean(0).tolist(), 1e4], 80, **kind)
    torch.testing.assert_close(everywhere, run(None, None, 80, law=stiffer, **kind), rtol=0, atol=1e-9)
    # in one corner: the squeeze differs there, not in the opposite one
    low = x.min(0).values
    low[1] = x[:, 1].max()
    corner = run("stiffness_contrast", [0.7, *low.tolist(), 0.03], 80, **kind)
    changed = (corner[-1] - run(None, None, 80, **kind)[-1]).norm(dim=1)
    near = (x - low).norm(dim=1) < 0.08
    assert changed[near].mean() > 2 * changed[~near].mean()


BAR = torch.cartesian_prod(
    torch.arange(0.0125, 0.8, 0.025, dtype=F64), *[torch.arange(0.0125, 0.1, 0.025, dtype=F64)] * 2
) + torch.tensor([0.0, 5.0, 0.0], dtype=F64)
"""A bar along x, 0.8 m long and 0.1 m wide: eight particles a cell."""
DENSITY = 1e3 * 0.2**3 / (len(BAR) * 0.025**3)
"""That of its matter: ``simulator`` divides 8 kg by the particles."""
THIN = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.0)


def angular_frequency(name, theta, *, x=BAR, axis=0, law=THIN):
    """Of the lowest longitudinal mode of a bar along ``axis`` that floats [rad/s]: from its largest elongation to its
    largest compression."""
    along = x[:, axis] - x[:, axis].min() - 0.0125
    shape = torch.cos(math.pi * (along + 0.0125) / 0.8)
    velocity = torch.zeros_like(x)
    velocity[:, axis] = -0.1 * shape
    start = at_rest(x, velocity, torch.zeros(len(x), 3, 3, dtype=F64))
    steps = list(range(1, 701))
    moved = run(name, theta, 700, x=x, state=start, gravity=WEIGHTLESS, outputs=steps, law=law)
    elongation = ((moved - x)[:, :, axis] * -shape).sum(1).numpy()
    spline = CubicSpline(np.array(steps) * DT, elongation)
    turns = spline.derivative().roots(extrapolate=False)
    return math.pi / (turns[1] - turns[0])


def test_a_bar_of_two_moduli_swings_as_on_paper():
    """Two halves of a floating bar: Z_1 tan(w L / 2 c_1) + Z_2 tan(w L / 2 c_2) = 0 with impedances Z = sqrt(E rho) and
    speeds c = sqrt(E / rho). Against the uniform bar on the same grid."""
    ratio, speed, half = 10.0, math.sqrt(2e4 / DENSITY), 0.4
    uniform = angular_frequency(None, None)
    assert uniform == pytest.approx(math.pi * speed / (2 * half), rel=0.02)

    def unbalanced(w):
        return math.tan(w * half / speed) + math.sqrt(ratio) * math.tan(w * half / speed / math.sqrt(ratio))

    low = math.pi * speed / (2 * half)
    on_paper = brentq(unbalanced, 1.001 * low, 1.999 * low)
    theta = [math.log(ratio), math.pi / 2, 0.0, 0.0, 0.01]
    found = angular_frequency("stiffness_contrast_half_space", theta)
    assert found / uniform == pytest.approx(on_paper / low, rel=0.02)


@pytest.mark.parametrize("angle", [0.0, math.pi / 4, math.pi / 2])
def test_a_bar_with_fibres_swings_as_on_paper(angle):
    """Stiffness E I + E_f a a a a of small strains (Poisson's ratio 0) at the angle phi from the fibres, by Sherman and
    Morrison: 1 / E_x = (1 - cos^4(phi) r / (1 + r)) / E with r = E_f / E. Against the bar without fibres."""
    ratio = 3.0
    expected = 1 / math.sqrt(1 - math.cos(angle) ** 4 * ratio / (1 + ratio))
    fibres = [ratio * THIN.values["youngs_modulus"], 0.0, math.pi / 2 - angle]  # from the vertical, towards z
    x = BAR[:, [2, 1, 0]].contiguous()
    found = angular_frequency("anisotropy", fibres, x=x, axis=2) / angular_frequency(None, None, x=x, axis=2)
    assert found == pytest.approx(expected, rel=0.02)


def test_stress_of_fibres_is_that_of_their_energy(taichi):
    """tau = (dW/dF) F^T with W = E_f (|F a|^2 - 1)^2 / 8, whatever the deformation; none of a rotation."""
    effect, modulus, lean = effects()["anisotropy"], 2e4, torch.tensor([0.4, -0.7], dtype=F64)
    function = effect.particle_stress()

    @ti.kernel
    def stress(f: ti.types.matrix(3, 3, ti.f64), c: ti.types.vector(4, ti.f64)) -> ti.types.matrix(3, 3, ti.f64):
        zero = ti.Matrix.zero(ti.f64, 3, 3)
        return function(zero, f, zero, c)

    a = direction(lean)
    c = effect.coefficients(torch.tensor([modulus, *lean], dtype=F64), setting(body()))[0]
    turned = Rotation.random(random_state=0).as_matrix()
    for f in (turned @ np.diag([1.3, 0.9, 0.8]), np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(3, 3))):
        given = torch.tensor(f, requires_grad=True)
        with torch.enable_grad():
            energy = modulus * ((given @ a).square().sum() - 1) ** 2 / 8
        (slope,) = torch.autograd.grad(energy, given)
        found = stress(ti.Matrix(f), ti.Vector(c.tolist())).to_numpy()
        np.testing.assert_allclose(found, (slope @ given.detach().T).numpy(), atol=1e-9 * modulus)
        assert np.abs(found).max() > 0.01 * modulus
    assert np.abs(stress(ti.Matrix(turned), ti.Vector(c.tolist())).to_numpy()).max() < 1e-9 * modulus


def test_half_space_contrast_is_the_side_that_the_normal_points_to():
    x = body()
    kind = {"x": x, "velocity": (0.5, -2.0, 0.0)}
    stiffer = ClassicalLaw("neo_hookean", youngs_modulus=2e4 * math.exp(0.7), poissons_ratio=0.3)
    everywhere = run("stiffness_contrast_half_space", [0.7, 0.3, -0.2, -50.0, 0.1], 80, **kind)
    torch.testing.assert_close(everywhere, run(None, None, 80, law=stiffer, **kind), rtol=0, atol=1e-9)
    effect, known = effects()["stiffness_contrast_half_space"], setting(x)
    upper = effect.shares(torch.tensor([1.0, 0.0, 0.0, 0.02, 0.01], dtype=F64), known)
    height = x[:, 1] - x[:, 1].mean() - 0.02
    torch.testing.assert_close(upper, torch.special.ndtr(height / 0.01), rtol=0, atol=1e-5)
    for normal in torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0))):
        found = direction(torch.tensor(inclination_of(normal)))
        assert abs(float(found @ normal)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("stretch", [0.9, 1.2])
def test_internal_pressure_balances_the_law_at_another_volume(stretch):
    """tau(lambda I) = [mu (lambda^2 - 1) + 3 lambda_L ln lambda] I of the law; a gas at constant temperature has p0 I
    at every volume. Without the gas the same body springs back."""
    x, mu, lame = body(height=5.0), 2e4 / 2 / 1.3, 2e4 * 0.3 / 1.3 / 0.4
    swollen = x.mean(0) + stretch * (x - x.mean(0))
    gradient = stretch * torch.eye(3, dtype=F64).expand(len(x), 3, 3)
    state = State(swollen, torch.zeros_like(x), torch.zeros_like(gradient), gradient)
    pressure = mu * (stretch**2 - 1) + 3 * lame * math.log(stretch)
    known = {"x": x, "state": state, "gravity": WEIGHTLESS}
    held, free = run("internal_pressure", [pressure], 80, **known), run(None, None, 80, **known)
    torch.testing.assert_close(held[-1], state.position, rtol=0, atol=1e-9)
    assert (free[-1] - state.position).norm(dim=1).mean() > 5e-3


def test_internal_pressure_swells_a_body_about_its_centre():
    x = body(height=5.0)
    arm = x - x.mean(0)
    for pressure in (300.0, -300.0):
        last = run("internal_pressure", [pressure], 10, x=x, gravity=WEIGHTLESS)[-1]
        np.testing.assert_allclose(last.mean(0).numpy(), x.mean(0).numpy(), atol=1e-9)
        assert math.copysign(1.0, ((last - x) * arm).sum().item()) == math.copysign(1.0, pressure)


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
