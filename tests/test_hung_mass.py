"""A mass on a thread: conservation, a pendulum, its weight, and inertia along the thread only."""

import math

import numpy as np
import pytest
import torch
from effect_cases import DT, F64, LAW, body, setting, simulator
from scipy.integrate import solve_ivp

from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.clamp import with_clamp
from masiv.effects.catalogue import effects
from masiv.effects.places import tied_weights, weights_around
from masiv.errors import InputError, MasivError
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout

G = 9.8
DOWN = torch.tensor([[0.0, -1.0, 0.0]], dtype=F64)


def active(x, mass=1.0, length=0.3, place=(0.1, 5.0, 0.1), *, others=(), held_above=None):
    """A mass that hangs from ``place``; the body is held where it is higher than ``held_above``."""
    members = [(effects()["hung_mass"], torch.tensor([mass, *place, length], dtype=F64))] if mass is not None else []
    members += [(effects()[name], torch.tensor(theta, dtype=F64)) for name, theta in others]
    found = ActiveEffects(tuple(members), setting(x))
    if held_above is None:
        return found
    return with_clamp(found, DOWN, torch.tensor([-held_above], dtype=F64))


def at_rest(x, velocity=(0.0, 0.0, 0.0)):
    return rigid_initial_state(x, torch.tensor(velocity, dtype=F64), torch.zeros(3, dtype=F64))


def run(x, effects_of, steps, *, state=None, gravity=(0, -G, 0), outputs=(), count=None):
    return simulator(len(x), gravity=gravity).run(state or at_rest(x), LAW, steps, list(outputs), effects_of)


def test_momentum_and_angular_momentum_of_body_and_mass_are_kept():
    """Weightless, the mass flies away, is caught by the thread and turns the body."""
    x = body(height=5.0)
    place = x.mean(0) + torch.tensor([0.05, -0.08, 0.0], dtype=F64)
    thrown = torch.stack([place + torch.tensor([0.0, -0.29, 0.0], dtype=F64), torch.tensor([0.3, -1.0, 0.2]).to(F64)])
    state = at_rest(x)
    state = type(state)(*state.tensors(), suspended=thrown)
    m = 8.0 / len(x)
    taken = run(x, active(x, 2.0, 0.3, tuple(place.tolist())), 300, state=state, gravity=(0, 0, 0))
    end, (y, u) = taken.final, taken.final.suspended
    assert float(end.velocity.mean(0).norm()) > 0.1
    torch.testing.assert_close(m * end.velocity.sum(0) + 2.0 * u, 2.0 * thrown[1], rtol=0, atol=1e-9)
    about = torch.linalg.cross(2.0 * thrown[0], thrown[1])
    spin = m * torch.linalg.cross(end.position, end.velocity).sum(0) + torch.linalg.cross(2.0 * y, u)
    # APIC's affine velocities carry a part of the angular momentum.
    spin += 0.25 * 0.05**2 * m * axial(end.affine_velocity).sum(0)
    torch.testing.assert_close(spin, about, rtol=0, atol=2e-2 * float(about.norm()))


def axial(c):
    return torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], 1)


def test_a_pendulum():
    """From a body that is held everywhere; released from 40 degrees, so that the period is not that of small swings."""
    x, length, angle = body(height=5.0), 0.3, math.radians(40)
    place = tuple(x.mean(0).tolist())
    aside = torch.tensor([length * math.sin(angle), -length * math.cos(angle), 0.0], dtype=F64)
    state = at_rest(x)
    start = torch.stack([x.mean(0) + aside, torch.zeros(3, dtype=F64)])
    state = type(state)(*state.tensors(), suspended=start)
    steps = 900
    taken = run(x, active(x, 0.1, length, place, held_above=0.0), steps, state=state)
    exact = solve_ivp(
        lambda t, s: [s[1], -G / length * math.sin(s[0])], (0, steps * DT), [angle, 0.0], rtol=1e-9, atol=1e-12
    ).y[:, -1]
    y = taken.final.suspended[0] - x.mean(0)
    assert float(y.norm()) == pytest.approx(length, rel=2e-4)
    assert math.atan2(float(y[0]), -float(y[1])) == pytest.approx(exact[0], abs=0.01)


def test_a_slack_thread_lets_both_fall():
    x = body(height=5.0)
    taken = run(x, active(x), 100, outputs=[100])
    alone = run(x, None, 100, outputs=[100])
    torch.testing.assert_close(taken.positions, alone.positions, rtol=0, atol=1e-9)


def end_of(x, place, found, steps, state=None):
    """Path (steps, 3) of what is around ``place``."""
    w = weights_around(x, torch.tensor(place, dtype=F64), 0.2 / 8)
    taken = run(x, found, steps, outputs=range(1, steps + 1), state=state)
    return (w[:, None] * taken.positions).sum(1).numpy()


def test_it_bobs_like_a_fixed_mass_and_swings_like_a_weight_without_inertia():
    x, mass, steps = body(height=5.0, count=400), 2.0, 400
    place = (0.1, 5.02, 0.1)
    held = 5.15
    hung = end_of(x, place, active(x, mass, 5.0, place, held_above=held), steps)
    fixed = end_of(x, place, active(x, None, others=[("point_mass", (mass, *place))], held_above=held), steps)
    weight = end_of(
        x, place, active(x, None, others=[("point_force", (0, -mass * G, 0, *place))], held_above=held), steps
    )
    # The thread takes part in the mean motion of what it is tied to, the fixed mass in that of each particle.
    apart = np.abs(weight[:, 1] - fixed[:, 1]).max()
    assert apart > 5e-3
    np.testing.assert_allclose(hung[:, 1], fixed[:, 1], atol=0.2 * apart)
    # Sideways, after a push of the body: as with the same weight, and not as with the same mass.
    pushed = at_rest(x, (0.3, 0.0, 0.0))
    hung = end_of(x, place, active(x, mass, 5.0, place, held_above=held), steps, pushed)
    weight = end_of(
        x, place, active(x, None, others=[("point_force", (0, -mass * G, 0, *place))], held_above=held), steps, pushed
    )
    fixed = end_of(x, place, active(x, None, others=[("point_mass", (mass, *place))], held_above=held), steps, pushed)
    swing = np.ptp(weight[:, 0])
    assert np.abs(hung[:, 0] - weight[:, 0]).max() < 0.1 * swing
    assert np.abs(fixed[:, 0] - weight[:, 0]).max() > 0.3 * swing


def test_without_a_thread_it_is_fixed_to_the_body():
    """At the middle of a face: it stays where it is tied, slows the body in all directions, and falls with it."""
    x, mass = body(height=5.0), 2.0
    place = (0.2, 5.1, 0.1)
    m = 8.0 / len(x)
    pushed = at_rest(x, (0.3, -0.1, 0.2))
    state = type(pushed)(*pushed.tensors(), suspended=torch.tensor([place, (0.0, 0.0, 0.0)], dtype=F64))
    found = active(x, mass, 0.0, place)
    taken = run(x, found, 300, state=state, gravity=(0, 0, 0))
    end, (y, u) = taken.final, taken.final.suspended
    start = m * pushed.velocity.sum(0)
    torch.testing.assert_close(m * end.velocity.sum(0) + mass * u, start, rtol=0, atol=1e-9)
    weights = tied_weights(x, torch.tensor(place, dtype=F64), 0.2 / 8)
    torch.testing.assert_close((weights[:, None] * end.position).sum(0), y, rtol=0, atol=1e-4)
    torch.testing.assert_close((weights[:, None] * end.velocity).sum(0), u, rtol=0, atol=5e-2)
    falling = run(x, found, 100).final
    fall = torch.tensor([0.0, -0.5 * G * (100 * DT) * (101 * DT), 0.0], dtype=F64)
    torch.testing.assert_close(falling.position, x + fall, rtol=0, atol=1e-9)


def test_a_mass_fixed_inside_moves_the_body_as_a_point_mass_does():
    x, mass, steps = body(height=5.0, count=400), 2.0, 400
    place, held = (0.1, 5.02, 0.1), 5.15
    pushed = at_rest(x, (0.3, 0.0, 0.0))
    fixed = end_of(x, place, active(x, mass, 0.0, place, held_above=held), steps, pushed)
    within = end_of(x, place, active(x, None, others=[("point_mass", (mass, *place))], held_above=held), steps, pushed)
    alone = end_of(x, place, active(x, None, held_above=held), steps, pushed)
    apart = np.abs(alone - within).max(0)
    assert (apart[:2] > 5e-3).all()
    np.testing.assert_allclose(fixed[:, :2], within[:, :2], atol=0.2 * apart[:2].min())


@pytest.mark.parametrize("place", [(0.1, 5.1, 0.1), (0.21, 5.1, 0.1), (0.1, 4.98, 0.1)])
def test_weights_of_a_tie_have_its_place_as_their_mean(place):
    """Also at a face, where no weights that are positive do."""
    x, place = body(height=5.0), torch.tensor(place, dtype=F64)
    tied, around = (weights(x, place, 0.2 / 8) for weights in (tied_weights, weights_around))
    assert tied.sum().item() == pytest.approx(1, abs=1e-9)
    torch.testing.assert_close((tied[:, None] * x).sum(0), place, rtol=0, atol=1e-6)
    off = float(((around[:, None] * x).sum(0) - place).norm())
    inside = bool((place < x.max(0).values).all() and (place > x.min(0).values).all())
    assert (off < 1e-3) == inside


def test_points_in_a_plane_can_be_tied_to():
    x = body(height=5.0)
    x[:, 2] = 0.1
    place = torch.tensor([0.2, 5.1, 0.1], dtype=F64)
    tied = tied_weights(x, place, 0.2 / 8)
    torch.testing.assert_close((tied[:, None] * x).sum(0), place, rtol=0, atol=1e-6)


def test_it_hangs_from_where_it_is_said_to_hang():
    """Guesses are the centres of the faces of the matter: a particle's cell ends half a spacing outside of it."""
    axis = (torch.arange(8, dtype=F64) + 0.5) / 8 * 0.2
    x = torch.cartesian_prod(axis, axis + 5.0, axis)
    guesses = effects()["hung_mass"].hints.guesses(setting(x))
    faces = {tuple(round(c, 4) for c in guess[:3]) for guess in guesses}
    assert faces == {
        (0.0, 5.1, 0.1),
        (0.2, 5.1, 0.1),
        (0.1, 5.0, 0.1),
        (0.1, 5.2, 0.1),
        (0.1, 5.1, 0.0),
        (0.1, 5.1, 0.2),
    }
    place = (0.2, 5.1, 0.1)
    taken = run(x, active(x, 1.0, 0.3, place, held_above=0.0), 1)
    hung = torch.tensor(place, dtype=F64) - torch.tensor([0.0, 0.3, 0.0], dtype=F64)
    torch.testing.assert_close(taken.final.suspended[0], hung, rtol=0, atol=1e-4)


def test_segments_continue_its_motion():
    """A rollout in two parts is one rollout: the state carries the mass."""
    x = body(height=5.0)
    found = active(x, held_above=5.1)
    whole = run(x, found, 60).final
    half = run(x, found, 30).final
    again = run(x, found, 30, state=half).final
    torch.testing.assert_close(again.position, whole.position, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.suspended, whole.suspended, rtol=0, atol=1e-12)


def test_it_has_no_gradient_and_hangs_alone():
    x = body(height=5.0)
    start = at_rest(x)
    moved = type(start)(start.position.clone().requires_grad_(), *start.tensors()[1:])
    end = rollout(simulator(len(x)), LAW, moved, 10, [10], active(x))
    with pytest.raises(MasivError, match="no gradient"):
        end.sum().backward()
    theta = torch.tensor([1.0, 0.1, 5.0, 0.1, 0.3], dtype=F64)
    with pytest.raises(InputError, match="both hang"):
        ActiveEffects(((effects()["hung_mass"], theta),) * 2, setting(x))
