"""How certain a cause is, beside noise that is smooth in space and time."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from masiv.inference.noise_model import NoiseModel
from masiv.inference.significance import vuong_z, wald_z_gls
from masiv.inference.smooth_noise import estimate_smooth_noise
from masiv.models.parameters import Parameter

INSTANTS, POINTS = 11, 120
LENGTH, METRES, SIZE = 2.0, 0.12, 2e-3
PLACES = np.random.default_rng(1).uniform(-0.3, 0.3, size=(POINTS, 3))
TIMES = np.arange(1.0, INSTANTS + 1)


OBSERVED = NoiseModel(
    [SimpleNamespace(points=PLACES, fit_count=INSTANTS, noise_std=SIZE, residual_std=np.full(INSTANTS, SIZE))]
)


def noises(count, seed=0):
    """``count`` fields (K, N, 3) [m] of noise that is as smooth as it says above."""
    random = np.random.default_rng(seed)
    lag = np.subtract.outer(TIMES, TIMES)
    apart = np.linalg.norm(PLACES[:, None] - PLACES[None], axis=2)
    time, space = (
        np.linalg.cholesky(np.exp(-0.5 * (d / length) ** 2) + 1e-6 * np.eye(len(d)))
        for d, length in ((lag, LENGTH), (apart, METRES))
    )
    return [SIZE * np.einsum("kl,nm,lma->kna", time, space, random.normal(size=(INSTANTS, POINTS, 3)))
            for _ in range(count)]  # fmt: skip


def fields_of(*patterns):
    """(M, P) of fields (K, N, 3)."""
    return np.stack([np.broadcast_to(p, (INSTANTS, POINTS, 3)).ravel() for p in patterns], axis=1)


def initial_motion():
    """What a fit absorbs: velocity and spin."""
    moved = [TIMES[:, None, None] * axis for axis in np.eye(3)]
    return moved + [TIMES[:, None, None] * np.cross(axis, PLACES) for axis in np.eye(3)]


SMOOTH = (TIMES**2)[:, None, None] * np.array([0.0, 1e-2, 0.0])
ROUGH = SMOOTH * np.sign(np.sin(60 * PLACES[:, :1]))


def found(noise, pattern, strength):
    """Least squares of a strength beside the launch, in an observation with ``noise_std``."""
    jacobian = fields_of(*initial_motion(), pattern)
    target = strength * jacobian[:, -1] + noise.ravel()
    theta = np.linalg.lstsq(jacobian, target, rcond=None)[0]
    names = [*"abcdef", "pull.strength"]
    parameters = [Parameter(n, 0.0, -9.0, 9.0, 1e-3) for n in names]
    fitted = SimpleNamespace(
        residual=jacobian @ theta - target, jacobian=jacobian, parameters=parameters,
        values=dict(zip(names, theta, strict=True)),
    )  # fmt: skip
    return fitted, SimpleNamespace(strengths=(parameters[-1],), others=())


@pytest.mark.slow
def test_lengths_are_those_of_the_noise_though_a_fit_took_its_smoothest_part():
    more = [TIMES[:, None, None] ** n * axis for n in (0, 2) for axis in np.eye(3)]
    jacobian = fields_of(*initial_motion(), *more, *[m * PLACES[:, k, None] for m in more for k in range(3)])
    lengths = []
    for noise in noises(8):
        left = noise.ravel() - jacobian @ np.linalg.lstsq(jacobian, noise.ravel(), rcond=None)[0]
        assert (left**2).mean() < 0.9 * (noise**2).mean()
        lengths.append(estimate_smooth_noise(left.reshape(noise.shape), jacobian.reshape(*noise.shape, -1), PLACES))
    assert np.median([n.correlation_time for n in lengths]) == pytest.approx(LENGTH, rel=0.3)
    assert np.median([n.correlation_length for n in lengths]) == pytest.approx(METRES, rel=0.35)
    assert np.median([n.variance for n in lengths]) == pytest.approx(SIZE**2, rel=0.35)
    coarse = PLACES[:4]
    assert estimate_smooth_noise(np.ones((9, 4, 3)), np.zeros((9, 4, 3, 0)), coarse) is None
    assert estimate_smooth_noise(np.ones((2, POINTS, 3)), np.zeros((2, POINTS, 3, 0)), PLACES) is None


@pytest.mark.parametrize("pattern", [SMOOTH, pytest.param(ROUGH, marks=pytest.mark.slow)], ids=["smooth", "rough"])
def test_noise_alone_is_as_certain_as_chance_has_it(pattern):
    z = np.array([wald_z_gls(*found(noise, pattern, 0.0), OBSERVED) for noise in noises(60, seed=2)])
    assert np.mean(z**2) == pytest.approx(1.0, rel=0.35)  # two standard deviations of a mean of 60
    assert np.mean(z > 2) <= 0.1
    assert z.max() < 3.5


def rivals(noise, patterns, strengths):
    """Least squares of each of two ``patterns`` alone, where both are there with ``strengths``."""
    target = fields_of(*patterns) @ np.array(strengths) + noise.ravel()
    out = []
    for pattern in patterns:
        jacobian = fields_of(*initial_motion(), pattern)
        theta = np.linalg.lstsq(jacobian, target, rcond=None)[0]
        out.append(SimpleNamespace(residual=jacobian @ theta - target, jacobian=jacobian))
    return out


BOTH = SMOOTH, (TIMES**2)[:, None, None] * np.array([3e-3, 0.0, 0.0]) * (1 + 3 * PLACES[:, :1])


@pytest.mark.slow
def test_of_two_causes_that_are_as_near_to_the_truth_chance_decides():
    fits = [rivals(noise, BOTH, (0.0, 0.0)) for noise in noises(40, seed=5)]
    sigmas = [vuong_z(*fit, OBSERVED) for fit in fits]
    assert np.mean(np.square(sigmas)) < 1.6
    assert np.mean(np.abs(sigmas) > 2) <= 0.1
    assert vuong_z(fits[0][0], fits[0][1], OBSERVED) == pytest.approx(-vuong_z(*fits[0][::-1], OBSERVED), rel=0.5)


def test_a_cause_that_is_there_is_told_from_one_that_is_not_the_better_the_more_they_differ():
    (noise,) = noises(1, seed=6)
    there, other = rivals(noise, BOTH, (1.0, 0.0))
    assert vuong_z(there, other, OBSERVED) > 4
    nearly = SMOOTH * (1 + 0.003 * PLACES[:, :1])
    there, other = rivals(noise, (SMOOTH, nearly), (1.0, 0.0))
    assert abs(vuong_z(there, other, OBSERVED)) < 2
    assert vuong_z(there, there, OBSERVED) == 0.0


def test_a_smooth_cause_is_less_certain_than_a_rough_one_of_the_same_size():
    (noise,) = noises(1, seed=3)
    smooth, rough = (wald_z_gls(*found(noise, p, 0.01), OBSERVED) for p in (SMOOTH, ROUGH))
    assert rough > 3 * smooth
    assert wald_z_gls(*found(noise, SMOOTH, 0.3), OBSERVED) > 6
    assert wald_z_gls(*found(noise, 0 * SMOOTH, 0.3), OBSERVED) == 0.0
