r"""Many coefficients from little data: least squares with a Gaussian prior whose sizes the data chooses.

The residual is linear in what is fitted, :math:`r(x) = r_0 + X x`, with errors :math:`N(0, \sigma^2)` and the prior
:math:`x \sim N(0, \Lambda^{-1})`. Then the most probable x and the marginal likelihood are closed (Bishop 2006, sec.
3.5):

.. math::  A = X^T X / \sigma^2 + \Lambda, \quad x = -A^{-1} X^T r_0 / \sigma^2, \quad
           \log p = \tfrac12 (\log|\Lambda| - \log|A| - n \log \sigma^2 - |r_0|^2 / \sigma^2 + x^T A x)

Of several priors and error sizes, that with the largest marginal likelihood is taken (empirical Bayes): coefficients
that the data does not ask for stay near zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Choice:
    """x (P,): the most probable coefficients with the prior ``precision`` (P, P) and the error ``std`` that make the
    data most probable, and their covariance (P, P). log_evidence: mean over all priors and errors to choose from, but
    for a constant of the data."""

    x: np.ndarray
    covariance: np.ndarray
    precision: np.ndarray
    std: float
    log_evidence: float


def most_probable(
    residual: np.ndarray, columns: np.ndarray, count: float, precisions: Sequence[np.ndarray], stds: Sequence[float]
) -> Choice:
    """residual (M,) at x = 0 and its derivatives columns (M, P), scaled such that their squares are those of ``count``
    independent values; precisions (P, P) of the priors and ``stds`` of the errors to choose from, equally likely."""
    gram, right, total = columns.T @ columns, columns.T @ residual, float(residual @ residual)
    found = []
    for precision in precisions:
        of_prior = np.linalg.slogdet(precision)[1]
        for std in stds:
            a = gram / std**2 + precision
            x = -np.linalg.solve(a, right / std**2)
            volume = of_prior - np.linalg.slogdet(a)[1] - 2 * count * np.log(std)
            found.append((0.5 * float(volume - total / std**2 + x @ a @ x), x, precision, std))
    evidence = np.array([row[0] for row in found])
    _, x, precision, std = found[int(evidence.argmax())]
    mean = float(np.logaddexp.reduce(evidence)) - math.log(len(found))
    return Choice(x, np.linalg.inv(gram / std**2 + precision), precision, std, mean)
