"""Frames in which a body is held at rest before it moves, found in its markers. Light: no torch, no taichi."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from masiv.tracks.release import MIN_FRAMES, estimate_release
from masiv.tracks.tracks import rest_positions

MIN_REST_FRAMES = 8
"""Fewer do not tell rest from a slow motion."""
MAX_BORDERS = 1000
"""Frames at which a stretch may begin or end; of longer records, evenly spaced ones."""
FALSE_REFUSAL = 1e-3
"""Probability that white noise about one place is refused."""


def find_rest(times: np.ndarray, positions: np.ndarray) -> tuple[slice, float] | None:
    """The longest stretch of frames in which markers (T, M, 3) [m] at ``times`` (T,) [s] rest before they move, and the
    time [s] of the release; None if there is none.

    A stretch is at rest if its variance about the mean is not larger than half the mean square successive difference
    (von Neumann 1941): for n white values the ratio of the two is 1, with the variance 1 / n. The ratios of all
    measured axes are averaged. Any motion that lasts for several frames makes it larger. A turning point of a motion
    does not, if it is short: so the markers must move much further after it than they would there (``_leaves``).
    """
    series = positions.reshape(len(positions), -1)
    series = series[:, np.isfinite(series).mean(0) > 0.5]
    whole = np.asarray(np.isfinite(series).all(axis=1))
    count = len(series)
    if not series.size or count < MIN_REST_FRAMES + MIN_FRAMES:
        return None
    values = np.where(whole[:, None], series - np.nanmedian(series, axis=0), 0.0)
    steps = np.square(np.diff(values, axis=0))
    sums, squares, jumps, gaps = (
        np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0)])
        for x in (values, np.square(values), steps, (~whole).astype(float)[:, None])
    )
    limit = float(norm.isf(FALSE_REFUSAL))
    found: slice | None = None
    stride = 1 + count // MAX_BORDERS
    for begin in range(0, count - MIN_REST_FRAMES, stride):
        shortest = MIN_REST_FRAMES if found is None else found.stop - found.start + 1
        ends = np.arange(begin + shortest, count + 1, stride)
        n = (ends - begin)[:, None]
        variance = (squares[ends] - squares[begin] - (sums[ends] - sums[begin]) ** 2 / n) / (n - 1)
        noise = (jumps[ends - 1] - jumps[begin]) / (2 * (n - 1))
        ratio = np.where(noise > 0, variance / np.maximum(noise, 1e-300), np.where(variance > 0, np.inf, 1.0)).mean(1)
        still = (ratio < 1 + limit / np.sqrt(series.shape[1] * n[:, 0])) & (gaps[ends, 0] == gaps[begin, 0])
        for end in ends[still][::-1]:
            if _leaves(series, slice(begin, int(end)), limit):
                found = slice(begin, int(end))
                break
    if found is None:
        return None
    at_rest, noise_std = rest_positions(positions, found)
    release = None if noise_std is None else estimate_release(times, positions, found, at_rest, noise_std)
    return None if release is None else (found, release)


def _leaves(series: np.ndarray, rest: slice, limit: float) -> bool:
    """Whether the values (T, K) leave their places in ``rest`` for several frames, within the length of ``rest``.

    By how much: at a turning point with constant acceleration in the middle of n frames, these values have a sagitta s
    and the variance 4 s² / 45, and n frames later they are 8 s away. The test of ``find_rest`` bears a variance of
    limit sqrt(K / n) in one axis, in units of the noise's.
    """
    count = rest.stop - rest.start
    after = series[rest.stop : rest.stop + count]
    if not len(after):
        return False
    spread = series[rest].std(0, ddof=1)
    sagitta = np.sqrt(45 / 4 * limit * np.sqrt(series.shape[1] / count))
    far = (np.abs(np.nan_to_num(after - series[rest].mean(0))) > 8 * sagitta * spread).any(1)
    return bool((np.convolve(far, np.ones(MIN_FRAMES)) > MIN_FRAMES - 0.5).any())
