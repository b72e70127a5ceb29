"""Effects on the stress, each in a case whose answer is known on paper."""

import math

import numpy as np
import pytest
import taichi as ti
import torch
from effect_cases import DT, F64, LAW, WEIGHTLESS, body, run, setting
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from masiv.effects.catalogue import effects
from masiv.effects.directions import direction, inclination_of
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.rollout import at_rest
from masiv.mpm.state import State


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


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
