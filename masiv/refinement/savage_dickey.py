r"""Evidence of the model without an effect, from the posterior of the model with it.

The model without is the one with at a strength of zero, so that the Bayes factor is the ratio of prior and posterior
density there (Dickey 1971, Ann. Math. Statist. 42). The evidence of a model knows of what another grid would change in
each coefficient on its own; that one grid moves all coefficients together is in the covariance of the posterior alone
(``Marginal.covariance``). A strength that this leaves uncertain down to zero is no evidence for the effect.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import log_ndtr

from masiv.inference.evidence import strength_scales
from masiv.models.base import EffectTerm
from masiv.refinement.hypotheses import Hypothesis

LOG2PI = math.log(2 * math.pi)


def log_bayes_factor(hypothesis: Hypothesis, term: EffectTerm) -> float:
    """For ``hypothesis``, against the same without its effect ``term``: the logarithm of the prior density of the
    strengths at zero over that of the posterior."""
    line, marginal = hypothesis.linear, hypothesis.marginal
    names = [p.name for p in line.parameters]
    index = [names.index(p.name) for p in term.strengths]
    positive = [p.lower >= 0 for p in term.strengths]
    mean = marginal.mean[index] + [p.fitted(line.values[p.name]) for p in term.strengths]
    covariance = marginal.covariance[np.ix_(index, index)]
    # Of those that cannot be negative, the density is over the positive half alone.
    prior = [
        sum(-math.log(strength_scales(p)[k]) + (math.log(2) if above else 0.0)
            for p, above in zip(term.strengths, positive, strict=True))
        for k in range(len(strength_scales(term.strengths[0])))
    ]  # fmt: skip
    at_zero = float(np.logaddexp.reduce(prior)) - math.log(len(prior)) - 0.5 * len(index) * LOG2PI
    posterior = -0.5 * (mean @ np.linalg.solve(covariance, mean) + np.linalg.slogdet(covariance)[1])
    posterior -= 0.5 * len(index) * LOG2PI
    spread = np.sqrt(np.diag(covariance))
    posterior -= sum(float(log_ndtr(m / s)) for m, s, above in zip(mean, spread, positive, strict=True) if above)
    return float(at_zero - posterior)
