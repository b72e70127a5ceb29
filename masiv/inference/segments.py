"""Instants of an observation in modes of motion, and what errors are expected of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.inference.error_covariance import ErrorBlock
from masiv.inference.motion_modes import MotionModes, rotations_since_start
from masiv.inference.noise_model import OBSERVATION_LIMITED_RATIO, one_more
from masiv.observations.base import Observation

MIN_TURNED_POINTS = 4
"""Fewer points do not tell how a body has turned."""
GRID_CORRELATION = 1 / 3
"""Correlation time of what another grid changes, over the length of the record."""
MIN_SEGMENT = 2
"""Instants of a segment that take part in decisions, at the least."""
MIN_SERIES = 0.1
"""Independent series of a group that moves with others, at the least."""
MAX_INSTANTS = 256
"""A longer record is thinned to as many."""
DIFFERENCES, DIFFERENCE_VARIANCE = 3, 20.0
"""Third differences leave little of a smooth motion; those of independent values have 20 times their variance."""
CHI2_MEDIAN = 0.4549
"""Median of the square of a standard normal variable."""


@dataclass(frozen=True)
class Segment:
    """Instants of an observation in modes of motion: those that are observation-limited, or those from the first on
    that is not, in which errors of the simulation move all modes together.

    kept: instants (T,), of which the first ``decided`` take part in decisions and the rest is for the test; what is
    expected is found from the former alone. turned: see ``MotionModes.coefficients``. jitter (G,) [m]: expected jitter
    of a coefficient; smooth: of each group, (T,) [m], the expected smooth error of a coefficient; grid: of each group,
    (T,) [m] by which another grid may change a coefficient, and grid_jitter: the part of that which is independent from
    instant to instant; grids: of each group, (S, T, K_g) [m] by which those that were tried differ from their mean;
    weights (G,): powers of the likelihood of each group; first_group: number of groups of other kinds of segments.
    """

    index: int
    observation: Observation
    modes: MotionModes
    kept: np.ndarray
    decided: int
    turned: np.ndarray | None
    jitter: tuple[float, ...]
    smooth: tuple[np.ndarray, ...]
    grid: tuple[np.ndarray, ...]
    grid_jitter: tuple[np.ndarray, ...]
    grids: tuple[np.ndarray, ...]
    weights: tuple[float, ...]
    first_group: int

    @classmethod
    def of(cls, index: int, observation: Observation, field: np.ndarray) -> list[Segment]:
        """Of observation number ``index``. field (T, N, A) [m]: the residual of the best model."""
        count, axes = field.shape[1:]
        modes = MotionModes.of(observation.points, axes)
        stride = math.ceil(len(field) / MAX_INSTANTS)
        seen = np.isfinite(observation.values).any(axis=(1, 2))
        kept = np.flatnonzero(seen)[::stride]
        decided = int((kept < observation.decided_count).sum())
        if decided < MIN_SEGMENT:
            return []
        turned = None
        if axes == 3 and count >= MIN_TURNED_POINTS:
            positions = np.where(np.isfinite(observation.values), observation.values, observation.points)
            turned = rotations_since_start(observation.points, positions[kept].astype(np.float64))
        grids = _grid_changes(observation, modes, kept, turned)
        grid, grid_jitter = tuple(map(_one_more, grids)), tuple(map(jitter_of_grids, grids))
        floor = float(observation.observation_std[kept].min()) / math.sqrt(axes * count)
        known_turn = None if turned is None else turned[:decided]
        jitter = tuple(jitter_of(c) or floor for c in modes.coefficients(field[kept[:decided]], known_turn))
        smooth = _smooth_errors(observation, modes, kept, turned) if count > 1 else (np.full(len(kept), jitter[0]),)
        limited = observation.residual_std[kept] < OBSERVATION_LIMITED_RATIO * observation.noise_std
        split = len(kept) if limited.all() or not observation.grid_corrections else int(np.argmin(limited))
        out = []
        for late, part in ((False, slice(0, split)), (True, slice(split, None))):
            count = len(kept[:decided][part])
            if count < MIN_SEGMENT:
                continue
            own = None if turned is None else turned[part]
            parts = modes.coefficients(field[kept[part][:count]], None if own is None else own[:count])
            out.append(
                cls(
                    index, observation, modes, kept[part], count, own, jitter, tuple(s[part] for s in smooth),
                    tuple(g[part] for g in grid), tuple(g[part] for g in grid_jitter), tuple(g[:, part] for g in grids),
                    _weights(parts, together=late), len(modes.names) if late else 0,
                )
            )  # fmt: skip
        return out

    def blocks(self, field: np.ndarray, jacobian: np.ndarray, *, test: bool = False) -> list[ErrorBlock]:
        """Of a residual field (T, N, A) [m] and its derivatives (T, N, A, P); with the instants of the test if asked
        for."""
        part = slice(None, None if test else self.decided)
        kept, turned = self.kept[part], None if self.turned is None else self.turned[part]
        times = self.observation.times[kept]
        lags = np.abs(np.subtract.outer(times, times))
        residuals = self.modes.coefficients(field[kept], turned)
        jacobians = self.modes.coefficients(jacobian[kept], turned)
        widths = [basis.shape[1] for basis in self.modes.bases]
        along_axis = np.sqrt(sum(k * s**2 for k, s in zip(widths, self.smooth, strict=True)) / self.modes.axes)
        motion = max(self.observation.extent / float(np.median(along_axis)), 1.0)
        return [
            ErrorBlock(
                residual, derivatives, lags, self.first_group + group, self.jitter[group],
                self.smooth[group][part], self.grid[group][part],
                GRID_CORRELATION * float(self.observation.times[-1]), self.weights[group], motion,
                self.grids[group][:, part], self.grid_jitter[group][part],
            )
            for group, (residual, derivatives) in enumerate(zip(residuals, jacobians, strict=True))
        ]  # fmt: skip


def _weights(residuals: Sequence[np.ndarray], *, together: bool) -> tuple[float, ...]:
    """Powers of the likelihoods of groups whose ``residuals`` are (T, K_g): the part of their series that is
    independent of others in the group; ``together``: and of the groups before, the first of which is the mean
    motion."""
    if not together:
        return tuple(independent_series(r, effective_instants(r)) / r.shape[1] for r in residuals)
    # All instants count: what a simulation lacks is smooth, and few independent instants would show nothing.
    series = [independent_series(r, len(r)) for r in residuals]
    known = 0.0
    for k in range(len(series)):
        whole = max(independent_series(np.concatenate(residuals[: k + 1], axis=1), len(residuals[0])), known)
        series[k] = min(series[k], max(whole - known, MIN_SERIES))
        known = whole
    return tuple(s / r.shape[1] for s, r in zip(series, residuals, strict=True))


def independent_series(residual: np.ndarray, instants: float) -> float:
    r"""How many independent series the coefficients (T, K) of a residual are worth, of K: the participation ratio
    :math:`(\operatorname{tr} C)^2 / \operatorname{tr} C^2` of their covariance C over the modes, of which T dependent
    instants, worth ``instants`` independent ones, show a sample.

    What a simulation lacks moves all modes together: then they are one series, not K.
    """
    count = residual.shape[1]
    power = np.linalg.svd(residual, compute_uv=False) ** 2
    if power.sum() == 0.0:
        return float(count)
    found = float((power**2).sum() / power.sum() ** 2)
    # Second moments of the Wishart distribution: E tr C'^2 = (1 + 1/n) tr C^2 + (tr C)^2 / n of the sample C'.
    inverse = (found - 1 / instants) / max(1 + (1 - 2 * found) / instants, 1 / instants)
    return 1 / min(max(inverse, 1 / count), 1.0)


def effective_instants(residual: np.ndarray) -> float:
    """How many independent instants show as much of the covariance over the modes as the coefficients (T, K):
    T^2 over the sum of the squared autocorrelation (Bartlett)."""
    instants = len(residual)
    spectrum = np.abs(np.fft.rfft(residual, 2 * instants, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum.sum(1))[:instants]
    if covariance[0] <= 0:
        return float(instants)
    squares = (covariance / covariance[0]) ** 2
    # The biased estimate has the factor 1 - lag/T once; a pair of instants of each lag exists as often.
    lags = 1 - np.arange(instants) / instants
    total = squares[0] + 2 * float((squares[1:] / np.maximum(lags[1:], 1 / instants)).sum())
    return instants / total


def jitter_of(residual: np.ndarray) -> float:
    """Standard deviation [m] of the independent errors in coefficients (T, K) whose residual is else smooth. 0 if there
    are too few instants to tell."""
    if len(residual) < 2 * DIFFERENCES:
        return 0.0
    left = np.diff(residual, DIFFERENCES, axis=0)
    return math.sqrt(float(np.median(left**2)) / CHI2_MEDIAN / DIFFERENCE_VARIANCE)


def _smooth_errors(
    observation: Observation, modes: MotionModes, kept: np.ndarray, turned: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """Expected size (T,) [m] of the smooth error of a coefficient, of each group: an equal share of the observation's
    expected error, and no less than the draw of errors that it may have, which does not fall as time goes on."""
    known = observation.observation_std[kept]
    shares = tuple(known / math.sqrt(basis.shape[1] * len(modes.bases)) for basis in modes.bases)
    if observation.tracking_error is None:
        return shares
    drawn = modes.coefficients(observation.tracking_error[kept], turned)
    sizes = [np.maximum.accumulate(np.sqrt((d**2).mean(1))) for d in drawn]
    return tuple(map(np.maximum, shares, sizes))


def _grid_changes(
    observation: Observation, modes: MotionModes, kept: np.ndarray, turned: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """Coefficients (S, T, K_g) [m] of each group of what S grids change beyond their mean."""
    if not observation.grid_corrections:
        return tuple(np.zeros((0, len(kept), basis.shape[1])) for basis in modes.bases)
    apart = [modes.coefficients((c - observation.grid_correction)[kept], turned) for c in observation.grid_corrections]
    return tuple(map(np.stack, zip(*apart, strict=True)))


def _one_more(grids: np.ndarray) -> np.ndarray:
    """By how much (T,) one more grid may differ from the mean of those that were tried (S, T, K), beyond it; it does
    not fall as time goes on."""
    count = len(grids)
    if count == 0:
        return np.zeros(grids.shape[1])
    return one_more(count) * np.maximum.accumulate(np.sqrt((grids**2).mean(2).mean(0)))


def jitter_of_grids(grids: np.ndarray) -> np.ndarray:
    """The same (T,) of what is not smooth in time: the root mean square of the third differences that an instant is
    part of, in units of those of independent values. A contact sets in at another instant on each grid."""
    count, instants = grids.shape[:2]
    if count == 0 or instants <= DIFFERENCES:
        return np.zeros(instants)
    squares = (np.diff(grids, DIFFERENCES, axis=1) ** 2).mean((0, 2)) / DIFFERENCE_VARIANCE
    windows = np.convolve(squares, np.ones(DIFFERENCES + 1))
    return one_more(count) * np.sqrt(windows / np.convolve(np.ones(len(squares)), np.ones(DIFFERENCES + 1)))
