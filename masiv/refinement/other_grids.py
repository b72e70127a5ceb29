"""Evidence of a model whatever the grid of its simulation is.

What a coarse grid does may look like an effect: a body on a sticky ground that is held by fewer nodes seems to slide.
The residual of a model is worked out on the finer grids that show what a grid changes, too, and its evidence is the
mean over all grids, of which none is better beforehand.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from masiv.inference.evidence import Evidence
from masiv.models.base import ForwardModel
from masiv.models.free_body import GRID_CORRECTION
from masiv.refinement.hypotheses import Hypothesis


def log_mean_evidence(forward_model: ForwardModel, hypothesis: Hypothesis, evidence: Evidence) -> float:
    """Logarithm of the mean evidence of ``hypothesis`` on its own grid and on each finer one, on which its derivatives
    are taken to be the same. Raises MasivError if it cannot be simulated there."""
    line, model = hypothesis.linear, hypothesis.fitted.model
    terms = [forward_model.term(n) for n in model.effects]
    observations = forward_model.observations
    changes = [forward_model.finer_grids(model, line.values, k) for k in range(len(observations))]
    uncorrected = [
        field - line.values.get(f"{GRID_CORRECTION}@{e.name}", 0.0) * e.grid_correction if e.grid_corrections else field
        for field, e in zip(line.fields, observations, strict=True)
    ]
    motions = [line.fields]
    for each in zip(*changes, strict=True):
        motions.append([field + change for field, change in zip(uncorrected, each, strict=True)])
    found = [evidence.marginal(replace(line, fields=fields), terms).log_evidence for fields in motions]
    return float(np.logaddexp.reduce(found)) - math.log(len(found))
