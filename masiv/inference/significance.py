"""How certain it is that a cause is there, with noise that is as smooth as the residual says it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.inference.smooth_noise import Smoothness, covariance_of, smoothness
from masiv.models.base import EffectTerm, Observation

OBSERVATION_LIMITED_RATIO = 1.5
"""Times the noise that sigma is where the motion is as well simulated as it is observed."""
UTMOST = 30.0
"""Sigmas that are as good as any more."""


def observation_limited(observation: Observation) -> np.ndarray:
    """Which fitted instants (rows,) are simulated as well as they are observed."""
    return observation.residual_std[: observation.fit_count] < OBSERVATION_LIMITED_RATIO * observation.noise_std


def wald_z_gls(fitted: ModelFit, term: EffectTerm, observations: Sequence[Observation]) -> float | None:
    """How many standard deviations of a normal variable the strengths of ``term`` are from none, all of them together
    (a chi-square of as many degrees), its places and frequencies held where they are. None where the residual cannot
    tell how smooth the noise is.

    The smoothness is that of what is left where the simulation is as certain as the observation: of the observation's
    errors alone, that is. Elsewhere residuals are as much larger as they are found to be; but errors of the simulation
    and of what is followed in pictures after a bounce are no noise, and many sigmas of one are no proof there.
    """
    from scipy.stats import chi2, norm

    held = {p.name for p in term.others}
    kept = [k for k, p in enumerate(fitted.parameters) if p.name not in held]
    names = [fitted.parameters[k].name for k in kept]
    jacobian = fitted.jacobian[:, kept]
    lengths = np.linalg.norm(jacobian, axis=0)
    strengths = [p.name for p in term.strengths if p.name in names and fitted.values[p.name] != 0.0]
    if not strengths or any(lengths[names.index(n)] == 0.0 for n in strengths):
        return 0.0
    lengths[lengths == 0.0] = 1.0
    u, s, vh = np.linalg.svd(jacobian / lengths, full_matrices=False)
    # Where columns are parallel, variances along the free direction are huge, not, as with a pseudo-inverse, nought.
    estimator = (u / np.maximum(s, s[0] * max(jacobian.shape) * np.finfo(float).eps)) @ vh / lengths
    covariance = np.zeros((len(kept), len(kept)))
    for e, part in _parts(fitted.residual.size, observations):
        field = fitted.residual[part].reshape(e.fit_count, len(e.points), -1)
        noise, scale = _noise_of(field, jacobian[part].reshape(*field.shape, -1), e)
        if noise is None:
            return None
        covariance += covariance_of(estimator[part].reshape(*field.shape, -1), noise, e.points, scale)
    index = [names.index(n) for n in strengths]
    theta = np.array([fitted.values[n] for n in strengths])
    inner = covariance[np.ix_(index, index)]
    unit = np.sqrt(np.diag(inner))
    squares = float((theta / unit) @ np.linalg.pinv(inner / np.outer(unit, unit), hermitian=True) @ (theta / unit))
    chance = float(chi2.sf(squares, len(strengths)))
    return min(float(norm.isf(chance / 2)), UTMOST) if chance > 0 else UTMOST


def vuong_z(best: ModelFit, other: ModelFit, observations: Sequence[Observation]) -> float | None:
    """By how many standard deviations ``best`` explains the fitted instants better than ``other``, a model that need
    not contain it (Vuong, Econometrica 57, 1989): the difference of their sums of squares, over what a noise as smooth
    as what ``best`` leaves would make of it, were both as near to the truth. None where the residual cannot tell how
    smooth that noise is."""
    apart = other.residual - best.residual
    gained = float(apart @ (other.residual + best.residual))
    variance = 0.0
    for e, part in _parts(best.residual.size, observations):
        field = best.residual[part].reshape(e.fit_count, len(e.points), -1)
        noise, scale = _noise_of(field, best.jacobian[part].reshape(*field.shape, -1), e)
        if noise is None:
            return None
        # d|r|² = 2 d·r: the noise enters along the difference of the two predictions.
        variance += 4 * float(covariance_of(apart[part].reshape(*field.shape, 1), noise, e.points, scale)[0, 0])
    return gained / math.sqrt(variance) if variance > 0 else 0.0


def _parts(size: int, observations: Sequence[Observation]) -> Iterator[tuple[Observation, slice]]:
    """What of a residual of ``size`` is of which experiment; all are measured in as many axes."""
    fitted = [e for e in observations if e.fit_count]
    axes = size // sum(e.fit_count * len(e.points) for e in fitted)
    begin = 0
    for e in fitted:
        end = begin + e.fit_count * len(e.points) * axes
        yield e, slice(begin, end)
        begin = end


def _noise_of(
    field: np.ndarray, sensitivities: np.ndarray, observation: Observation
) -> tuple[Smoothness | None, np.ndarray]:
    """The noise in a residual ``field`` (K, N, A), and how much larger it is at each instant (K,)."""
    known = observation_limited(observation)
    noise = smoothness(field[known], sensitivities[known], observation.points)
    if noise is None:  # too short a time of that: all of it
        return smoothness(field, sensitivities, observation.points), np.ones(len(field))
    squares = (field**2).mean((1, 2))
    here, there = (float(squares[part].mean()) if part.any() else 0.0 for part in (known, ~known))
    return noise, np.where(known, 1.0, math.sqrt(max(1.0, there / here)))
