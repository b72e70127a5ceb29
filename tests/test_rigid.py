"""Rigid motion: what leaves it, and where a flight was turned aside."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.observations.noise_floor import noise_floor
from masiv.rigid import ballistic_positions, beyond_rigid, beyond_uniform, free_flight, impact_point, turned_freely

GRAVITY = np.array([0.0, -9.8, 0.0])
VELOCITY, OMEGA = np.array([1.2, 0.4, 0.3]), np.array([0.4, 2.0, 3.0])
TIMES = np.arange(9) / 24


@pytest.fixture
def body():
    return np.random.default_rng(1).uniform(-0.2, 0.2, (500, 3)) + np.array([0.0, 1.0, 0.0])


@pytest.fixture
def flight(body):
    return np.stack([ballistic_positions(body, VELOCITY, OMEGA, GRAVITY, t) for t in TIMES])


def test_a_flight_is_found_from_its_positions(flight):
    velocity, omega = free_flight(flight, TIMES, GRAVITY)
    np.testing.assert_allclose(velocity, VELOCITY, atol=1e-9)
    np.testing.assert_allclose(omega, OMEGA, atol=1e-4)  # the turn is worked out in steps
    assert beyond_rigid(flight).max() < 1e-9


def test_a_long_body_wobbles_as_a_symmetric_top():
    """Poinsot: its axis goes round the angular momentum L at L / I, while it turns about its axis at (1 - I_axis / I)
    of its spin along it."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = 0.05 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(12)])
    body = np.concatenate([ring + np.array([0, 0, z]) for z in np.linspace(-0.2, 0.2, 20)])
    along, across = (body[:, :2] ** 2).sum(), (body[:, 1:] ** 2).sum()
    omega = np.array([3.0, 0.0, 4.0])
    momentum = np.array([across * omega[0], 0.0, along * omega[2]])
    for turn, t in zip(turned_freely(body, omega, TIMES[1:]), TIMES[1:], strict=True):
        own = Rotation.from_rotvec([0, 0, (1 - along / across) * omega[2] * t])
        due = Rotation.from_rotvec(momentum / across * t) * own
        assert (turn * due.inv()).magnitude() < 1e-3
    flight = np.stack([ballistic_positions(body, VELOCITY, omega, GRAVITY, t) for t in TIMES])
    np.testing.assert_allclose(free_flight(flight, TIMES, GRAVITY)[1], omega, atol=1e-2)


def test_a_uniform_strain_is_not_rigid_but_uniform(flight):
    stretched = flight.copy()
    stretched[3] = flight[3] @ np.diag([1.1, 0.95, 1.0])
    assert beyond_rigid(stretched)[2] > 5e-3
    assert beyond_uniform(stretched).max() < 1e-9


def test_a_body_that_swells_in_flight_is_not_taken_for_noise(flight):
    noise = 1e-3 * np.random.default_rng(0).normal(size=flight.shape)
    noise[0] = 0
    centre = flight.mean(1, keepdims=True)
    swollen = centre + (1 + 0.1 * np.sin(20 * TIMES))[:, None, None] * (flight - centre)
    assert noise_floor(swollen + noise, 8) < 1.7 * noise_floor(flight + noise, 8)
    assert np.mean(beyond_rigid(swollen)) > 10e-3


def test_a_flight_that_is_turned_aside_shows_where(flight):
    assert impact_point(flight, TIMES, GRAVITY) is None
    centre, radius = flight[6].mean(0) + np.array([0.25, 0.0, 0.0]), 0.15
    turned = flight.copy()
    for frame in (6, 7, 8):  # nothing is inside of the sphere
        arm = turned[frame] - centre
        distance = np.linalg.norm(arm, axis=1, keepdims=True)
        turned[frame] = centre + arm / distance * np.maximum(distance, radius)
    turned[1:] += 1e-3 * np.random.default_rng(0).normal(size=turned[1:].shape)
    place = impact_point(turned, TIMES, GRAVITY)
    assert np.linalg.norm(place - centre) < 0.6 * radius

    guesses = effect_named("hidden_obstacle").guesses(
        EffectContext(
            torch.as_tensor(GRAVITY), torch.as_tensor(flight[0]), 0.1, 0.4, 0.4, 1 / 24, torch.as_tensor(turned)
        )
    )
    np.testing.assert_allclose(guesses[0], place)
