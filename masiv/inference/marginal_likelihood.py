r"""How probable a motion is under a model, its parameters and the sizes of its errors integrated out.

About a fit, the residual is linear in the parameters, :math:`r(\theta) = r + J (\theta - \hat\theta)`. With Gaussian
priors :math:`\theta \sim N(\mu, \Lambda^{-1})` and Gaussian errors :math:`N(0, C)` the marginal likelihood is closed,

.. math::  \log p(r) = \log N(r + J (\mu - \hat\theta);\ 0,\ C + J \Lambda^{-1} J^T),

(Bishop 2006, sec. 3.5). The sizes of the errors are where it is largest together with their prior, times the volume of
their posterior (Laplace; MacKay 1992). The prior of an effect's strength is a mixture of normal densities about zero
whose scales are spread evenly in the logarithm: a strength of any size is nearly as likely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs
from scipy.optimize import minimize
from scipy.special import log_ndtr

from masiv.inference.error_covariance import BlockCovariance, ErrorBlock, ErrorSizes

JITTER_SD, SMOOTH_SD, GRID_SD = 0.7, 1.0, 0.5
"""Standard deviations of the logarithms of the factors: the expected sizes are good to a factor of two or three."""
STARTS = (
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, -1.5, 0.0, 0.0),
    (-2.0, 0.0, 0.5, 0.0, -1.0),
    (-2.0, -1.0, -1.0, 3.0, 0.0),
)
"""Where fits of the sizes begin, in standard deviations of their priors: jitter, smooth, length, grid, its jitter."""
MAX_FITS = 2
"""Of which the most probable ones go on."""
REACH = 6.0
"""How far sizes may be from what is expected, in standard deviations of the prior."""
TOLERANCE = 1e-2
"""Slope of the log density by a size, in standard deviations of the prior, at which their fit ends: the evidence is
then known to about the square of it."""
LOG2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class ParameterPriors:
    """Of P parameters, in their fitted scales, about the values at which the residual was linearised.

    mean (P,): prior mean less fitted value. precision (S, P): of S components of a mixture of normal densities, equally
    likely. positive: indices of the strengths that cannot be negative. Their probability of being positive is taken for
    the product of each one's: exact if all but one are far from zero, as those are that were named.
    """

    mean: np.ndarray
    precision: np.ndarray
    positive: tuple[int, ...] = ()


@dataclass(frozen=True)
class Marginal:
    """log_evidence: logarithm of the marginal likelihood. mean, covariance: of the parameters less their fitted values,
    (P,) and (P, P), over the mixture; what one more grid would change in the mean is in the covariance. logs (3 G +
    2,): logarithms of the sizes of the errors (``ErrorSizes``). unknown: posterior probability that something unknown
    acts as well."""

    log_evidence: float
    mean: np.ndarray
    covariance: np.ndarray
    logs: np.ndarray
    unknown: float = 0.0

    @property
    def sizes(self) -> ErrorSizes:
        return ErrorSizes.of_logarithms(self.logs)


@dataclass(frozen=True)
class SizePriors:
    """Normal priors of ``logs`` (3 G + 2,), see ``ErrorSizes``."""

    mean: np.ndarray
    sd: np.ndarray

    @classmethod
    def of(cls, blocks: Sequence[ErrorBlock]) -> SizePriors:
        """Jitter and smooth errors as expected; correlation times between the interval of two instants and the length
        of the record."""
        groups = 1 + max(b.group for b in blocks)
        lengths, spreads = np.zeros(groups), np.ones(groups)
        for g in range(groups):
            own = [b for b in blocks if b.group == g]
            longest = np.log(max(float(b.lags.max()) for b in own))
            shortest = np.log(np.median([_interval(b.lags) for b in own]))
            lengths[g], spreads[g] = 0.5 * (longest + shortest), max((longest - shortest) / 4, 0.3)
        mean = np.concatenate([np.zeros(2 * groups), lengths, np.zeros(2)])
        sd = np.concatenate([np.full(groups, JITTER_SD), np.full(groups, SMOOTH_SD), spreads, [GRID_SD, SMOOTH_SD]])
        return cls(mean, sd)

    def with_unknown(self, blocks: Sequence[ErrorBlock]) -> SizePriors:
        """If something unknown acts: it moves the body smoothly, by anything between an error and the whole motion
        (a discrepancy of the model; Kennedy & O'Hagan 2001). These are two standard deviations from the mean of the
        logarithm: it is unlikely that what acts moves the body by less than an error."""
        groups = len(self.mean) // 3
        largest = [max(b.motion for b in blocks if b.group == g) for g in range(groups)]
        half = 0.5 * np.log(largest)
        mean, sd = self.mean.copy(), self.sd.copy()
        mean[groups : 2 * groups] = half
        sd[groups : 2 * groups] = np.maximum(half / 2, SMOOTH_SD)
        return SizePriors(mean, sd)

    def starts(self) -> list[np.ndarray]:
        """Sizes from which their fit begins, in standard deviations from the mean: as expected, rough, smooth, and with
        more of another grid."""
        groups = len(self.mean) // 3
        return [np.array([*np.repeat(start[:3], groups), *start[3:]]) for start in STARTS]


def _interval(lags: np.ndarray) -> float:
    return float(np.median(np.diag(lags, 1))) if len(lags) > 1 else 1.0


def _columns(block: ErrorBlock, offset: np.ndarray) -> np.ndarray:
    """(T, 1 + P, K): the residual ``offset`` (P,) from the fitted values, and the derivatives."""
    residual = block.residual + block.jacobian @ offset
    return np.concatenate([residual[:, None], block.jacobian.swapaxes(1, 2)], axis=1)


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """The lower factor (T, T), zero above. LAPACK without SciPy's checks, which take longer than the small matrices of
    a record. Raises LinAlgError."""
    factor, info = dpotrf(matrix, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"the covariance of errors is not positive definite (minor {info})")
    return factor


class _Likelihood:
    """The marginal likelihood as a function of the logarithms of the sizes."""

    def __init__(self, blocks: Sequence[ErrorBlock], priors: ParameterPriors, sizes: SizePriors) -> None:
        self.covariances = [BlockCovariance(b) for b in blocks]
        # The residual at the prior mean, and the derivatives: (T, 1 + P, K), whose rows of one column lie together.
        self.data = [np.asfortranarray(_columns(b, priors.mean).reshape(len(b.residual), -1)) for b in blocks]
        self.priors, self.sizes, self.columns = priors, sizes, 1 + len(priors.mean)

    def terms(self, logs: np.ndarray, *, gradient: bool = False) -> _Terms:
        """Of each component of the prior; with the gradient of the sum of all by ``logs`` if asked for."""
        gram, constant = np.zeros((self.columns, self.columns)), 0.0
        whitened = []
        for known, data in zip(self.covariances, self.data, strict=True):
            covariance, weight = known.at(logs), known.block.weight
            factor = _cholesky(covariance.matrix)
            white = dtrtrs(factor, data, lower=1)[0]
            rows = white.reshape((-1, self.columns), order="F")
            gram += weight * (rows.T @ rows)
            each = np.log(factor.diagonal()).sum() + 0.5 * len(data) * LOG2PI
            constant -= weight * known.block.residual.shape[1] * each
            whitened.append((covariance, factor, white))
        logp, mean, spread, by_gram = self._components(gram)
        terms = _Terms(constant + logp, mean, spread)
        if not gradient:
            return terms
        share = np.exp(terms.logp - np.logaddexp.reduce(terms.logp))
        slope = np.tensordot(share, by_gram, 1)
        out = np.zeros(len(logs))
        for known, (covariance, factor, white) in zip(self.covariances, whitened, strict=True):
            solved = dtrtrs(factor, white, lower=1, trans=1)[0]
            # (slope @ rows.T).T: its columns lie as those of the rows do.
            sloped = (slope @ solved.reshape((-1, self.columns), order="F").T).T
            by_covariance = sloped.reshape(solved.shape, order="F") @ solved.T
            lower = dpotri(factor, lower=1)[0]  # of the inverse, and zero above
            half = 0.5 * known.block.residual.shape[1]
            by_covariance += half * (lower + lower.T - np.diag(lower.diagonal()))
            covariance.add_gradient(out, -known.block.weight * by_covariance)
        return replace(terms, gradient=out)

    def by_another_grid(self, logs: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Covariance (P, P) of the mean of parameters with ``covariance`` (P, P), if one more grid differs from the
        mean of the S grids as they do: its error moves all modes together, which the covariance of errors does not
        know."""
        moved = []
        for known, data in zip(self.covariances, self.data, strict=True):
            grids = known.block.grids
            if grids is None or len(grids) < 2:
                continue
            factor = cholesky(known(logs), lower=True, check_finite=False)
            each = np.moveaxis(grids, 0, 1).reshape(len(factor), -1)  # (T, S, K), as the data
            solved = cho_solve((factor, True), np.asfortranarray(each), check_finite=False)
            derivatives = data.reshape((-1, self.columns), order="F")[:, 1:]
            moved.append(known.block.weight * (derivatives.T @ solved.reshape((-1, len(grids)), order="F")))
        if not moved:
            return np.zeros_like(covariance)
        shifts = covariance @ np.sum(moved, axis=0)
        count = shifts.shape[1]
        return shifts @ shifts.T * (count + 1) / (count * (count - 1))

    def _components(self, gram: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """log p but for a constant (S,), mean (S, P) about the prior mean and covariance (S, P, P) of each component,
        and the gradient (S, 1 + P, 1 + P) of log p by ``gram``."""
        precision = self.priors.precision
        count, size = precision.shape
        covariance = np.linalg.inv(gram[1:, 1:] + precision[:, :, None] * np.eye(size))
        solved = covariance @ gram[1:, 0]
        determinant = np.linalg.slogdet(covariance)[1] if size else np.zeros(count)
        logp = -0.5 * (gram[0, 0] - solved @ gram[1:, 0]) + 0.5 * (determinant + np.log(precision).sum(1))
        direction = np.concatenate([np.ones((count, 1)), -solved], axis=1)
        slope = -0.5 * direction[:, :, None] * direction[:, None, :]
        slope[:, 1:, 1:] -= 0.5 * covariance
        for k in self.priors.positive:
            column = covariance[:, k]
            sd = np.sqrt(column[:, k])
            z = -solved[:, k] / sd  # the prior, of mean zero, has half of its mass above zero
            logp = logp + log_ndtr(z) + math.log(2)
            by_z = np.exp(-0.5 * z**2 - 0.5 * LOG2PI - log_ndtr(z))
            by_right = -column / sd[:, None]
            both = column[:, :, None] * solved[:, None, :]
            by_matrix = 0.5 * (both + both.swapaxes(1, 2)) / sd[:, None, None]
            by_matrix -= (solved[:, k] / (2 * sd**3))[:, None, None] * column[:, :, None] * column[:, None, :]
            slope[:, 1:, 1:] += by_z[:, None, None] * by_matrix
            slope[:, 1:, 0] += 0.5 * by_z[:, None] * by_right
            slope[:, 0, 1:] += 0.5 * by_z[:, None] * by_right
        return logp, -solved, covariance, slope

    def objective(self, logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus the logarithm of the posterior of the sizes, and its gradient."""
        terms = self.terms(logs, gradient=True)
        assert terms.gradient is not None
        z = (logs - self.sizes.mean) / self.sizes.sd
        value = float(np.logaddexp.reduce(terms.logp)) - math.log(len(terms.logp)) - 0.5 * float(z @ z)
        return -value, -(terms.gradient - z / self.sizes.sd)


@dataclass(frozen=True)
class _Terms:
    """logp (S,), mean (S, P) about the prior mean, covariance (S, P, P) of each component; gradient of log p."""

    logp: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    gradient: np.ndarray | None = None


def marginal(
    blocks: Sequence[ErrorBlock], priors: ParameterPriors, sizes: SizePriors, starts: Sequence[np.ndarray] = ()
) -> Marginal:
    """The marginal likelihood of ``blocks``, over all of them: a composite likelihood (Varin, Reid & Firth 2011) if
    their weights are not 1. starts: logarithms of the sizes (3 G + 2,) from which their fit begins; usual ones if there
    are none."""
    likelihood = _Likelihood(blocks, priors, sizes)

    def objective(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = likelihood.objective(sizes.mean + sizes.sd * z)
        return value, gradient * sizes.sd

    # The posterior has several modes: a rough residual is jitter, or smooth errors of a short time.
    options = {"maxiter": 200, "gtol": TOLERANCE}
    bounds = [(-REACH, REACH)] * len(sizes.mean)
    tried = [(s - sizes.mean) / sizes.sd for s in starts] or sizes.starts()
    found = min(
        (
            minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            for start in sorted(tried, key=lambda z: objective(z)[0])[:MAX_FITS]
        ),
        key=lambda result: result.fun,
    )
    logs = sizes.mean + sizes.sd * found.x
    hessian = _hessian(likelihood.objective, logs, sizes.sd)
    # Volume of the posterior of the sizes over that of their prior.
    volume = -0.5 * np.linalg.slogdet(hessian * np.outer(sizes.sd, sizes.sd))[1]
    return replace(_given_sizes(likelihood, logs), log_evidence=-float(found.fun) + float(volume))


def marginal_of_sizes(blocks: Sequence[ErrorBlock], priors: ParameterPriors, logs: np.ndarray) -> Marginal:
    """The same if the sizes of the errors are known: ``logs`` are their logarithms (3 G + 2,)."""
    return _given_sizes(_Likelihood(blocks, priors, SizePriors.of(blocks)), logs)


def _given_sizes(likelihood: _Likelihood, logs: np.ndarray) -> Marginal:
    terms = likelihood.terms(logs)
    log_evidence = float(np.logaddexp.reduce(terms.logp))
    weights = np.exp(terms.logp - log_evidence)
    mean, spread = _moments(weights, terms.mean, terms.covariance)
    spread = spread + likelihood.by_another_grid(logs, np.tensordot(weights, terms.covariance, 1))
    log_evidence -= math.log(len(terms.logp))
    return Marginal(log_evidence, likelihood.priors.mean + mean, spread, logs)


def _moments(weights: np.ndarray, means: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (P,) and covariance (P, P) of a mixture of components with ``weights`` (S,)."""
    mean = weights @ means
    apart = means - mean
    return mean, np.tensordot(weights, covariances + apart[:, :, None] * apart[:, None, :], 1)


def marginal_with_unknown(
    blocks: Sequence[ErrorBlock], priors: ParameterPriors, known: SizePriors, unknown: SizePriors,
    starts: Sequence[np.ndarray] = (),
) -> Marginal:  # fmt: skip
    """Over whether something unknown acts, which is half as likely as that it does not (as one effect more is): then
    the sizes have the prior ``unknown``, else ``known``."""
    without = marginal(blocks, priors, known, starts)
    groups = len(known.mean) // 3
    larger = without.logs.copy()
    larger[groups : 2 * groups] = unknown.mean[groups : 2 * groups]
    parts = (without, marginal(blocks, priors, unknown, (without.logs, larger)))
    logs = np.array([m.log_evidence + math.log(p) for m, p in zip(parts, (2 / 3, 1 / 3), strict=True)])
    total = float(np.logaddexp.reduce(logs))
    weights = np.exp(logs - total)
    mean, spread = _moments(weights, np.stack([m.mean for m in parts]), np.stack([m.covariance for m in parts]))
    return Marginal(total, mean, spread, parts[int(weights.argmax())].logs, float(weights[1]))


Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


def _hessian(objective: Objective, at: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Second derivatives of the objective by differences of its gradient; a tenth of those of the prior at the
    least."""
    count = len(at)
    out = np.zeros((count, count))
    for k in range(count):
        step = np.zeros(count)
        step[k] = 1e-3
        out[k] = (objective(at + step)[1] - objective(at - step)[1]) / 2e-3
    out = 0.5 * (out + out.T)
    values, vectors = np.linalg.eigh(out * np.outer(sd, sd))
    values = np.maximum(values, 0.1)
    return (vectors * values) @ vectors.T / np.outer(sd, sd)
