"""Predictions of models that lack nothing: how large a residual should be, and what follows on later instants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.inference.error_model import ErrorModel
from masiv.inference.evidence import Evidence
from masiv.inference.linear_model import LinearModel
from masiv.inference.marginal_likelihood import Marginal, SizePriors
from masiv.models.base import EffectTerm

DRAWS = 400
"""Draws from which the prior predictive probability is estimated."""


def predictive_p(evidence: Evidence, linear: LinearModel, terms: Sequence[EffectTerm], seed: int = 0) -> float:
    """Probability of a residual as large as that of the model, if nothing is missing and the errors are as expected
    (prior predictive check; Box, J. R. Stat. Soc. A 143, 1980).

    Residuals are compared after the fit that takes errors for what is expected of them. The modes of a draw are as
    dependent on each other as those of the residual.
    """
    blocks, priors = tuple(evidence.blocks(linear)), evidence.priors(linear, terms)
    sizes = SizePriors.of(blocks)
    expected = ErrorModel(blocks, sizes.mean)
    columns = _flat(expected.whiten([b.jacobian for b in blocks]))
    columns = np.concatenate([columns, np.diag(np.sqrt(priors.precision[0]))])
    basis = np.linalg.qr(columns)[0][: -columns.shape[1] or None] if columns.shape[1] else columns

    def size(residuals: Sequence[np.ndarray]) -> float:
        white = _flat(expected.whiten(residuals))
        return float((white**2).sum() - ((basis.T @ white) ** 2).sum())

    observed = size([b.residual for b in blocks])
    rng = np.random.default_rng(seed)
    larger = 0
    for _ in range(DRAWS):
        logs = sizes.mean + sizes.sd * rng.normal(size=len(sizes.mean))
        larger += size(ErrorModel(blocks, logs).draw(rng)) >= observed
    return (larger + 1) / (DRAWS + 1)


def _flat(coefficients: Sequence[np.ndarray]) -> np.ndarray:
    """Coefficients (T, K, ...) of all blocks, (M, ...)."""
    return np.concatenate([c.reshape(-1, *c.shape[2:]) for c in coefficients])


@dataclass(frozen=True)
class Forecast:
    """Of the instants of the test, given all others. expected_mm: root mean square distance [mm] that a model expects,
    in its modes of motion; found_mm: what it is. log_density: logarithm of the predictive density."""

    expected_mm: float
    found_mm: float
    log_density: float


def forecast(
    evidence: Evidence, linear: LinearModel, terms: Sequence[EffectTerm], decided: Marginal
) -> Forecast | None:
    """What the model ``linear`` with the effects ``terms`` says of the instants of the test, with errors as large as
    ``decided``, its marginal likelihood of the other instants, has them. None if there are none.

    Errors go on from the instants before (``ErrorModel.conditional``); parameters are as uncertain as after these.
    """
    blocks, past = evidence.blocks(linear, test=True), evidence.blocks(linear)
    later = ErrorModel(tuple(blocks), decided.logs).conditional([p.residual + p.jacobian @ decided.mean for p in past])
    groups, instants = len(evidence.segments[0].modes.names), 0
    expected, found = 0.0, 0.0
    for b, p, (mean, covariance) in zip(blocks, past, later, strict=True):
        jacobian, residual = b.jacobian[len(p.residual) :], b.residual[len(p.residual) :]
        spread = np.einsum("tki,ij,tkj->tk", jacobian, decided.covariance, jacobian)
        shift = jacobian @ decided.mean  # the fit need not be at the mean of the posterior
        expected += float(((mean - shift) ** 2 + np.diag(covariance)[:, None] + spread).sum())
        found += float((residual**2).sum())
        instants += len(residual) if b.group % groups == 0 else 0
    if not instants:
        return None
    whole = evidence.marginal(linear, terms, test=True).log_evidence
    expected_mm, found_mm = (1e3 * math.sqrt(total / instants) for total in (expected, found))
    return Forecast(expected_mm, found_mm, whole - decided.log_evidence)
