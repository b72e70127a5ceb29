"""What finer grids change: how uncertain it makes residuals and values. Closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from masiv.inference.discretization import with_residual_std
from masiv.models.base import ForwardModel
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

INSTANTS, ROWS, POINTS = 6, 4, 5
NOISE = 1e-3


class Changing(ForwardModel):
    """Finer grids make ``changes`` (T, N, 3) [m]."""

    def __init__(self, *changes):
        self.changes = changes
        observation = Observation(
            name="0", times=np.arange(INSTANTS) / 24, points=np.zeros((POINTS, 3)),
            values=np.zeros((INSTANTS, POINTS, 3)), fit_count=ROWS, noise_std=NOISE,
            residual_std=np.full(INSTANTS, NOISE),
        )  # fmt: skip
        super().__init__([observation])

    def parameters(self, model):
        raise AssertionError("not needed here")

    candidates = term = fields = parameters

    def finer_grids(self, model, values, index):
        return list(self.changes)


def parameters():
    return [Parameter("a", 0.0, -100.0, 100.0, 1e-3), Parameter("b", 0.0, -100.0, 2.0, 1e-3)]


def test_what_a_fit_absorbs_or_all_grids_change_is_no_uncertainty():
    random = np.random.default_rng(2)
    jacobian = random.normal(size=(ROWS * POINTS * 3, 2))
    shape = (INSTANTS, POINTS, 3)
    absorbed = np.zeros(shape)
    absorbed[:ROWS] = 1e-2 * (jacobian @ np.array([1.0, -2.0])).reshape(ROWS, POINTS, 3)
    sizes = np.sqrt((absorbed[:ROWS] ** 2).sum(2).mean(1))
    assert (sizes > 10 * NOISE).all()
    fitted = SimpleNamespace(jacobian=jacobian, model=None, values={}, parameters=parameters())

    def found(*changes, fitted=fitted):
        given = Changing(*changes)
        updated = with_residual_std(given, fitted, [np.full(INSTANTS, NOISE)])
        np.testing.assert_array_equal(given.observations[0].residual_std, NOISE)  # the given one stays as it is
        assert given.observations[0].grid_corrections == ()
        return updated.observations[0]

    np.testing.assert_allclose(found(absorbed, 2 * absorbed).residual_std, NOISE, rtol=1e-6)
    common, apart = 3e-2 * random.normal(size=shape), 1e-2 * random.normal(size=shape)
    alike = found(common, 1.2 * common + absorbed)
    np.testing.assert_allclose(alike.residual_std, NOISE, rtol=1e-6)
    np.testing.assert_array_equal(alike.grid_corrections, [common, 1.2 * common + absorbed])
    differing = found(common + apart, common - apart)
    rms = np.sqrt((apart**2).sum(2).mean(1))
    # A third grid is off the mean of two by the square root of three times as much as they are.
    assert (np.sqrt(differing.residual_std**2 - NOISE**2)[:ROWS] >= 0.8 * np.sqrt(3) * rms[:ROWS]).all()
    assert (differing.residual_std <= 3 * np.maximum.accumulate(rms) + NOISE).all()
    assert (np.diff(differing.residual_std) >= 0).all()
    # What an earlier mean had absorbed does not count.
    columns = np.concatenate([apart[:ROWS].reshape(-1, 1), jacobian], axis=1)
    share = Parameter("grid_change@0", 0.0, -1.0, 3.0, 0.25)
    again = SimpleNamespace(jacobian=columns, model=None, values={}, parameters=[share, *parameters()])
    np.testing.assert_array_equal(
        found(common + apart, common - apart, fitted=again).residual_std, differing.residual_std
    )
    assert found().grid_corrections == ()
    np.testing.assert_array_equal(found().residual_std, NOISE)
