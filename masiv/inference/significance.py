"""How significant a term is, and a preference between two models, with noise as smooth as the residual says it is."""

from __future__ import annotations

import math

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import NoiseModel
from masiv.models.base import EffectTerm

MAX_Z = 30.0
"""Standard deviations above which more make no difference."""


def wald_z_gls(fitted: ModelFit, term: EffectTerm, noise: NoiseModel) -> float | None:
    """How many standard deviations of a normal variable the strengths of ``term`` are from zero, all together (Wald's
    statistic, a chi-square of as many degrees), its places and frequencies held. None if the residual cannot tell how
    smooth the noise is.

    Errors of the simulation, and of points that are followed in pictures after a bounce, are no noise: many standard
    deviations are no proof there.
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
    # If columns are parallel, variances along the free direction are huge, not zero as with a pseudo-inverse.
    estimator = (u / np.maximum(s, s[0] * max(jacobian.shape) * np.finfo(float).eps)) @ vh / lengths
    covariance = noise.estimator_covariance(fitted.residual, jacobian, estimator)
    if covariance is None:
        return None
    index = [names.index(n) for n in strengths]
    theta = np.array([fitted.values[n] for n in strengths])
    inner = covariance[np.ix_(index, index)]
    unit = np.sqrt(np.diag(inner))
    squares = float((theta / unit) @ np.linalg.pinv(inner / np.outer(unit, unit), hermitian=True) @ (theta / unit))
    chance = float(chi2.sf(squares, len(strengths)))
    return min(float(norm.isf(chance / 2)), MAX_Z) if chance > 0 else MAX_Z


def vuong_z(best: ModelFit, other: ModelFit, noise: NoiseModel) -> float | None:
    """By how many standard deviations ``best`` explains the fitted instants better than ``other``, a model that need
    not contain it (Vuong, Econometrica 57, 1989): the difference of their sums of squares, over what a noise as smooth
    as what ``best`` leaves would make of it if both were as near to the truth. None if the residual cannot tell how
    smooth that noise is."""
    apart = other.residual - best.residual
    gained = float(apart @ (other.residual + best.residual))
    # d|r|² = 2 d·r: the noise enters along the difference of the two predictions.
    covariance = noise.estimator_covariance(best.residual, best.jacobian, apart[:, None])
    if covariance is None:
        return None
    variance = 4 * float(covariance[0, 0])
    return gained / math.sqrt(variance) if variance > 0 else 0.0
