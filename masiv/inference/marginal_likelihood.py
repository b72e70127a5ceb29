r"""How probable a motion is under a model, its parameters and the sizes of its errors integrated out.

About a fit, the residual is linear in the parameters, :math:`r(\theta) = r + J (\theta - \hat\theta)`. With Gaussian
priors :math:`\theta \sim N(\mu, \Lambda^{-1})` and Gaussian errors :math:`N(0, C)` the marginal likelihood is closed,

.. math::  \log p(r) = \log N(r + J (\mu - \hat\theta);\ 0,\ C + J \Lambda^{-1} J^T),

(Bishop 2006, sec. 3.5). The sizes of the errors are where it is largest together with their prior, times the volume of
their posterior (Laplace; MacKay 1992). The prior of an effect's strength is a mixture of normal densities about zero whose
scales are spread evenly in the logarithm: a strength of any size is nearly as likely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize

from masiv.inference.error_covariance import ErrorBlock, ErrorSizes, covariance

JITTER_SD, SMOOTH_SD, GRID_SD = 0.7, 1.0, 0.5
"""Standard deviations of the logarithms of the factors: the expected sizes are good to a factor of two or three."""
LOG2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class ParameterPriors:
    """Of P parameters, in their fitted scales, about the values at which the residual was linearised.

    mean (P,): prior mean less fitted value. precision (S, P): of S components of a mixture of normal densities, equally
    likely. positive: index of the one strength that cannot be negative, None if there is none or several.
    """

    mean: np.ndarray
    precision: np.ndarray
    positive: int | None = None


@dataclass(frozen=True)
class Marginal:
    """log_evidence: logarithm of the marginal likelihood. mean, covariance: of the parameters less their fitted values,
    (P,) and (P, P), over the mixture. weights (S,): posterior of the mixture's components. sizes: of the errors."""

    log_evidence: float
    mean: np.ndarray
    covariance: np.ndarray
    weights: np.ndarray
    sizes: ErrorSizes
    log_sizes: np.ndarray


@dataclass(frozen=True)
class SizePriors:
    """Normal priors of ``logs`` (3 G + 1,), see ``ErrorSizes``."""

    mean: np.ndarray
    sd: np.ndarray

    @classmethod
    def of(cls, blocks: Sequence[ErrorBlock]) -> SizePriors:
        """Jitter and smooth errors as expected; correlation times between the interval of two instants and the length of
        the record."""
        groups = 1 + max(b.group for b in blocks)
        lengths, spreads = np.zeros(groups), np.ones(groups)
        for g in range(groups):
            own = [b for b in blocks if b.group == g]
            longest = np.log(max(float(b.lags.max()) for b in own))
            shortest = np.log(np.median([_interval(b.lags) for b in own]))
            lengths[g], spreads[g] = 0.5 * (longest + shortest), max((longest - shortest) / 4, 0.3)
        mean = np.concatenate([np.zeros(2 * groups), lengths, [0.0]])
        sd = np.concatenate([np.full(groups, JITTER_SD), np.full(groups, SMOOTH_SD), spreads, [GRID_SD]])
        return cls(mean, sd)


def _interval(lags: np.ndarray) -> float:
    return float(np.median(np.diag(lags, 1))) if len(lags) > 1 else 1.0


class _Likelihood:
    """The marginal likelihood as a function of the logarithms of the sizes."""

    def __init__(self, blocks: Sequence[ErrorBlock], priors: ParameterPriors, sizes: SizePriors) -> None:
        self.blocks = [
            (
                b.group, b.jitter, torch.as_tensor(b.smooth), torch.as_tensor(b.grid), torch.as_tensor(b.lags),
                b.grid_length, b.residual.shape[1],
                torch.as_tensor(np.concatenate(
                    [(b.residual + b.jacobian @ priors.mean)[:, :, None], b.jacobian], axis=2
                ).reshape(len(b.residual), -1)),
            )
            for b in blocks
        ]  # fmt: skip
        self.columns = blocks[0].jacobian.shape[2] + 1
        self.precision = torch.as_tensor(priors.precision)
        self.positive = priors.positive
        self.size_mean, self.size_sd = torch.as_tensor(sizes.mean), torch.as_tensor(sizes.sd)
        self.groups = len(sizes.mean) // 3

    def terms(self, logs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """log p (S,) of each component, and of it the mean (S, P) about the prior mean, and precision (S, P, P)."""
        values, groups = torch.exp(logs), self.groups
        gram = torch.zeros((self.columns,) * 2, dtype=torch.float64)
        constant = torch.zeros((), dtype=torch.float64)
        for group, jitter, smooth, grid, lags, grid_length, modes, data in self.blocks:
            c = covariance(
                lags, jitter * values[group], smooth * values[groups + group], values[2 * groups + group],
                grid * values[-1], grid_length,
            )  # fmt: skip
            factor = torch.linalg.cholesky(c)
            white = torch.linalg.solve_triangular(factor, data, upper=False).reshape(-1, self.columns)
            gram = gram + white.T @ white
            constant = constant - modes * (torch.log(factor.diagonal()).sum() + 0.5 * len(lags) * LOG2PI)
        b = gram[1:, 0]
        a = gram[1:, 1:] + torch.diag_embed(self.precision)
        if a.shape[1] == 0:
            return (constant - 0.5 * gram[0, 0])[None], torch.zeros(1, 0), a, constant
        factor = torch.linalg.cholesky(a)
        solved = torch.cholesky_solve(b[None, :, None].expand(len(a), -1, 1), factor)[:, :, 0]
        out = constant - 0.5 * (gram[0, 0] - solved @ b)
        out = out - torch.log(factor.diagonal(dim1=1, dim2=2)).sum(1) + 0.5 * torch.log(self.precision).sum(1)
        if self.positive is not None:
            k = self.positive
            inverse = torch.cholesky_inverse(factor)
            # The prior has half of its mass above zero.
            z = (self.offset - solved[:, k]) / torch.sqrt(inverse[:, k, k])
            out = out + torch.special.log_ndtr(z) + math.log(2.0)
        return out, -solved, a, constant

    offset = 0.0
    """Prior mean of the positive parameter, which is zero."""

    def log_posterior(self, logs: torch.Tensor) -> torch.Tensor:
        """log p of the residual and of the sizes."""
        terms = self.terms(logs)[0]
        prior = -0.5 * (((logs - self.size_mean) / self.size_sd) ** 2).sum()
        return torch.logsumexp(terms, 0) - math.log(len(terms)) + prior


def marginal(
    blocks: Sequence[ErrorBlock], priors: ParameterPriors, sizes: SizePriors, start: np.ndarray | None = None
) -> Marginal:
    """The marginal likelihood of ``blocks``, over all of them. start (3 G + 1,): logarithms of sizes to begin with."""
    likelihood = _Likelihood(blocks, priors, sizes)

    def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.tensor(logs, requires_grad=True)
        value = -likelihood.log_posterior(x)
        value.backward()
        assert x.grad is not None
        return value.item(), x.grad.numpy()

    reach = 6.0 * sizes.sd
    found = minimize(
        objective, sizes.mean if start is None else start, jac=True, method="L-BFGS-B",
        bounds=list(zip(sizes.mean - reach, sizes.mean + reach, strict=True)), options={"maxiter": 200},
    )  # fmt: skip
    logs = torch.tensor(found.x)
    hessian = _hessian(objective, found.x, sizes.sd)
    # Volume of the posterior of the sizes over that of their prior.
    volume = -0.5 * np.linalg.slogdet(hessian * np.outer(sizes.sd, sizes.sd))[1]
    with torch.no_grad():
        terms, about_mean, precision, _ = likelihood.terms(logs)
        weights = torch.softmax(terms, 0)
        covariances = torch.linalg.inv(precision) if precision.shape[1] else precision
        mean = weights @ about_mean
        apart = about_mean - mean
        spread = torch.einsum("s,sij->ij", weights, covariances + apart[:, :, None] * apart[:, None, :])
    return Marginal(
        -float(found.fun) + float(volume), priors.mean + mean.numpy(), spread.numpy(), weights.numpy(),
        ErrorSizes.of_logarithms(found.x), found.x,
    )  # fmt: skip


def _hessian(objective, at: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Second derivatives of the objective by differences of its gradient, at least those of the prior alone."""
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
