"""The evidence for models of the same observations: their marginal likelihoods over all instants."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.inference.error_covariance import ErrorBlock
from masiv.inference.linear_model import LinearModel
from masiv.inference.marginal_likelihood import Marginal, ParameterPriors, SizePriors, marginal_with_unknown
from masiv.inference.segments import Segment
from masiv.models.base import EffectTerm
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

STRENGTH_SCALES = 5
"""Scales of an effect's strength that its prior mixes, from the finite-difference step to the bound."""
NUISANCE_SD = 100.0
"""Prior standard deviation of what is fitted to one held-out observation alone, in its own unit: nothing is known."""

GRAVITY_EFFECT, GRAVITY_SD = "gravity_scale", 0.005
"""Gravity on Earth varies by 0.5 % from the equator to the poles; the scale of a recording is hardly known better."""


@dataclass(frozen=True)
class Evidence:
    """Works out the evidence of models of ``observations``, with one expectation of errors for all of them."""

    observations: Sequence[Observation]
    segments: tuple[Segment, ...]

    @classmethod
    def of(cls, observations: Sequence[Observation], fields: Sequence[np.ndarray]) -> Evidence:
        """fields: the residual of the best model at all instants."""
        pairs = enumerate(zip(observations, fields, strict=True))
        segments = [segment for k, (e, f) in pairs for segment in Segment.of(k, e, f)]
        used = sorted({s.first_group for s in segments})
        if used == [len(segments[0].modes.names)]:  # no instant is observation-limited
            segments = [replace(s, first_group=0) for s in segments]
        return cls(tuple(observations), tuple(segments))

    def marginal(
        self, linear: LinearModel, terms: Sequence[EffectTerm], *, test: bool = False, near: Marginal | None = None
    ) -> Marginal:
        """The marginal likelihood of a model with the effects ``terms``; of the instants of the test as well if asked
        for. near: that of a model which is little different."""
        return self.marginal_with(linear, self.priors(linear, terms), test=test, near=near)

    def marginal_with(
        self, linear: LinearModel, priors: ParameterPriors, *, test: bool = False, near: Marginal | None = None
    ) -> Marginal:
        """The same with other ``priors`` of its parameters."""
        blocks = self.blocks(linear)
        known = SizePriors.of(blocks)
        unknown = known.with_unknown(blocks)
        if test:
            blocks = self.blocks(linear, test=True)
        return marginal_with_unknown(blocks, priors, known, unknown, (near.logs,) if near else ())

    def blocks(self, linear: LinearModel, *, test: bool = False) -> list[ErrorBlock]:
        """Of all observations; columns are the model's parameters, then the nuisance of each observation."""
        widths = [n.shape[-1] for n in linear.nuisance]
        out = []
        for segment in self.segments:
            k = segment.index
            own = [
                linear.nuisance[j] if j == k else np.zeros((*linear.fields[k].shape, widths[j]))
                for j in range(len(self.observations))
            ]
            out += segment.blocks(linear.fields[k], np.concatenate([linear.jacobians[k], *own], axis=-1), test=test)
        return out

    def priors(self, linear: LinearModel, terms: Sequence[EffectTerm]) -> ParameterPriors:
        """Strengths: a mixture of normal densities about zero. What is known of gravity: normal. All others: flat, over
        the range that is possible and that this recording could show."""
        names = [p.name for p in linear.parameters]
        terms = [t for t in terms if all(p.name in names for p in t.strengths)]  # the others are known
        nuisance = sum(n.shape[-1] for n in linear.nuisance)
        strengths = {p.name for t in terms for p in t.strengths}
        units = {name: unit for t in terms for name, unit in t.units.items()}
        mean = np.array([-linear.values[n] if n in strengths else 0.0 for n in names] + [0.0] * nuisance)
        flat = [
            GRAVITY_SD**-2
            if p.name.split(".")[0] == GRAVITY_EFFECT and p.name not in strengths
            else 12 / self.range_of(p, units.get(p.name)) ** 2
            for p in linear.parameters
        ]
        flat += [NUISANCE_SD**-2] * nuisance
        rows = []
        for chosen in itertools.product(range(STRENGTH_SCALES), repeat=len(terms)):
            row = np.array(flat)
            for term, k in zip(terms, chosen, strict=True):
                for p in term.strengths:
                    row[names.index(p.name)] = strength_scales(p)[k] ** -2
            rows.append(row)
        positive = tuple(names.index(p.name) for t in terms for p in t.strengths if p.lower >= 0)
        return ParameterPriors(mean, np.array(rows), positive)

    def range_of(self, p: Parameter, unit: str | None) -> float:
        """Of ``p`` in its fitted scale: between its bounds. Places: no farther than the motion went; frequencies: from
        one period in the record to two instants a period."""
        whole = p.fitted(p.upper) - p.fitted(p.lower)
        if unit == "m" and p.name.rsplit(".", 1)[-1] in ("x", "y", "z"):
            return min(whole, max(e.extent for e in self.observations))
        if unit == "Hz":
            times = self.observations[0].times
            return min(whole, 0.5 / float(np.median(np.diff(times))))
        return whole


def strength_scales(p: Parameter) -> np.ndarray:
    """Scales of the prior of the strength ``p``, evenly in the logarithm."""
    return np.geomspace(p.step, max(abs(p.lower), abs(p.upper)), STRENGTH_SCALES)
