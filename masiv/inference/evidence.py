"""The evidence for models of the same observations: their marginal likelihoods over all instants."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.inference.error_covariance import BlockCovariance, ErrorBlock
from masiv.inference.linear_model import LinearModel
from masiv.inference.marginal_likelihood import Marginal, ParameterPriors, SizePriors, marginal
from masiv.inference.motion_modes import TRANSLATION, MotionModes, rotations_since_start
from masiv.models.base import EffectTerm
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation

STRENGTH_SCALES = 5
"""Scales of an effect's strength that its prior mixes, from the finite-difference step to the bound."""
NUISANCE_SD = 100.0
"""Prior standard deviation of what is fitted to one held-out observation alone, in its own unit: nothing is known."""
MIN_TURNED_POINTS = 4
"""Fewer points do not tell how a body has turned."""
GRID_CORRELATION = 1 / 3
"""Correlation time of what another grid changes, over the length of the record."""
MAX_INSTANTS = 256
"""A longer record is thinned to as many."""
DIFFERENCES, DIFFERENCE_VARIANCE = 3, 20.0
"""Third differences leave little of a smooth motion; those of independent values have 20 times their variance."""
CHI2_MEDIAN = 0.4549
"""Median of the square of a standard normal variable."""


@dataclass(frozen=True)
class _ObservationModes:
    """An observation in modes of motion. kept: instants (T,); turned: see ``MotionModes.coefficients``. jitter (G,) [m]:
    expected jitter of a coefficient; smooth (T,) [m]: expected smooth error of a point along an axis; grid: of each
    group, (T,) [m] by which another grid may change a coefficient."""

    observation: Observation
    modes: MotionModes
    kept: np.ndarray
    turned: np.ndarray | None
    jitter: tuple[float, ...]
    smooth: np.ndarray
    grid: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, observation: Observation, field: np.ndarray) -> _ObservationModes:
        """field (T, N, A) [m]: the residual of the best model, which shows the jitter."""
        count, axes = field.shape[1:]
        modes = MotionModes.of(observation.points, axes)
        stride = math.ceil(len(field) / MAX_INSTANTS)
        seen = np.isfinite(observation.values).any(axis=(1, 2))
        kept = np.flatnonzero(seen)[::stride]
        turned = None
        if axes == 3 and count >= MIN_TURNED_POINTS:
            positions = np.where(np.isfinite(observation.values), observation.values, observation.points)
            turned = rotations_since_start(observation.points, positions[kept].astype(np.float64))
        parts = modes.coefficients(field[kept], turned)
        known = observation.observation_std[kept] / math.sqrt(axes)
        jitter = [jitter_of(c) for c in parts]
        floor = float(known.min()) / math.sqrt(count)
        jitter = [j if j > 0 else floor for j in jitter]
        smooth = np.full(len(kept), jitter[0]) if count == 1 else known
        return cls(
            observation, modes, kept, turned, tuple(jitter), smooth, _grid_changes(observation, modes, kept, turned)
        )

    def blocks(self, field: np.ndarray, jacobian: np.ndarray) -> list[ErrorBlock]:
        """Of a residual field (T, N, A) [m] and its derivatives (T, N, A, P)."""
        times = self.observation.times[self.kept]
        lags = np.abs(np.subtract.outer(times, times))
        residuals = self.modes.coefficients(field[self.kept], self.turned)
        jacobians = self.modes.coefficients(jacobian[self.kept], self.turned)
        groups = len(self.modes.names)
        return [
            ErrorBlock(
                residual, derivatives, lags, group, self.jitter[group],
                self.smooth * math.sqrt(self.modes.axes / (residual.shape[1] * groups)), self.grid[group],
                GRID_CORRELATION * float(lags.max()),
            )
            for group, (residual, derivatives) in enumerate(zip(residuals, jacobians, strict=True))
        ]  # fmt: skip


def jitter_of(residual: np.ndarray) -> float:
    """Standard deviation [m] of the independent errors in coefficients (T, K) whose residual is else smooth. 0 if there
    are too few instants to tell."""
    if len(residual) < 2 * DIFFERENCES:
        return 0.0
    left = np.diff(residual, DIFFERENCES, axis=0)
    return math.sqrt(float(np.median(left**2)) / CHI2_MEDIAN / DIFFERENCE_VARIANCE)


def _grid_changes(
    observation: Observation, modes: MotionModes, kept: np.ndarray, turned: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """By how much one more grid may differ from the mean of those that were tried, beyond it; it does not fall as time
    goes on."""
    if not observation.grid_corrections:
        return tuple(np.zeros(len(kept)) for _ in modes.names)
    count = len(observation.grid_corrections)
    apart = [modes.coefficients((c - observation.grid_correction)[kept], turned) for c in observation.grid_corrections]
    more = math.sqrt((count + 1) / (count - 1))
    return tuple(
        more * np.maximum.accumulate(np.sqrt(np.mean([(c[g] ** 2).mean(1) for c in apart], axis=0)))
        for g in range(len(modes.names))
    )


def independent_series(residuals: Sequence[np.ndarray]) -> float:
    """How many independent series the coefficients (T, K) of residuals are worth, of K: the participation ratio of their
    covariance over the modes, corrected for how few instants show it.

    What a simulation lacks moves all modes together: then they are one series, not K.
    """
    count = residuals[0].shape[1]
    joined = np.concatenate(residuals)
    power = np.linalg.svd(joined, compute_uv=False) ** 2
    if power.sum() == 0.0:
        return float(count)
    inverse = float((power**2).sum() / power.sum() ** 2) - 1 / len(joined)
    return 1 / max(inverse, 1 / count)


@dataclass(frozen=True)
class Evidence:
    """Works out the evidence of models of ``observations``, with one expectation of errors for all of them. weight: see
    ``marginal``."""

    observations: Sequence[Observation]
    parts: tuple[_ObservationModes, ...]
    weight: float = 1.0

    @classmethod
    def of(cls, observations: Sequence[Observation], fields: Sequence[np.ndarray]) -> Evidence:
        """fields: the residual of the best model at all instants."""
        parts = tuple(_ObservationModes.of(e, f) for e, f in zip(observations, fields, strict=True))
        residuals = [
            np.concatenate(part.modes.coefficients(f[part.kept], part.turned), axis=1)
            for part, f in zip(parts, fields, strict=True)
        ]
        same = [r for r in residuals if r.shape[1] == residuals[0].shape[1]]
        return cls(tuple(observations), parts, independent_series(same) / residuals[0].shape[1])

    def marginal(self, linear: LinearModel, terms: Sequence[EffectTerm]) -> Marginal:
        """The marginal likelihood of a model with the effects ``terms``."""
        return self.marginal_with(linear, self.priors(linear, terms))

    def marginal_with(self, linear: LinearModel, priors: ParameterPriors) -> Marginal:
        """The same with other ``priors`` of its parameters."""
        blocks = self.blocks(linear)
        return marginal(blocks, priors, SizePriors.of(blocks), self.weight)

    def blocks(self, linear: LinearModel) -> list[ErrorBlock]:
        """Of all observations; columns are the model's parameters, then the nuisance of each observation."""
        widths = [n.shape[-1] for n in linear.nuisance]
        out = []
        for k, part in enumerate(self.parts):
            own = [
                linear.nuisance[j] if j == k else np.zeros((*linear.fields[k].shape, widths[j]))
                for j in range(len(self.parts))
            ]
            out += part.blocks(linear.fields[k], np.concatenate([linear.jacobians[k], *own], axis=-1))
        return out

    def priors(self, linear: LinearModel, terms: Sequence[EffectTerm]) -> ParameterPriors:
        """Strengths: a mixture of normal densities about zero. All others: flat, over the range that is possible and that
        this recording could show."""
        names = [p.name for p in linear.parameters]
        terms = [t for t in terms if all(p.name in names for p in t.strengths)]  # the others are known
        nuisance = sum(n.shape[-1] for n in linear.nuisance)
        strengths = {p.name for t in terms for p in t.strengths}
        units = {name: unit for t in terms for name, unit in t.units.items()}
        mean = np.array([-linear.values[n] if n in strengths else 0.0 for n in names] + [0.0] * nuisance)
        flat = [12 / self.range_of(p, units.get(p.name)) ** 2 for p in linear.parameters] + [NUISANCE_SD**-2] * nuisance
        rows = []
        for chosen in itertools.product(range(STRENGTH_SCALES), repeat=len(terms)):
            row = np.array(flat)
            for term, k in zip(terms, chosen, strict=True):
                for p in term.strengths:
                    row[names.index(p.name)] = strength_scales(p)[k] ** -2
            rows.append(row)
        single = terms[0].strengths if len(terms) == 1 else ()
        positive = names.index(single[0].name) if len(single) == 1 and single[0].lower >= 0 else None
        return ParameterPriors(mean, np.array(rows), positive)

    def range_of(self, p: Parameter, unit: str | None) -> float:
        """Of ``p`` in its fitted scale: between its bounds. Places: no farther than the motion went; frequencies: from
        one period in the record to two instants a period."""
        whole = p.fitted(p.upper) - p.fitted(p.lower)
        if unit == "m" and p.name.rsplit(".", 1)[-1] in ("x", "y", "z"):
            reached = np.concatenate(
                [np.nanmax(e.values, (0, 1)) - np.nanmin(e.values, (0, 1)) for e in self.observations]
            )
            return min(whole, float(reached.max()))
        if unit == "Hz":
            times = self.observations[0].times
            return min(whole, 0.5 / float(np.median(np.diff(times))))
        return whole


def strength_scales(p: Parameter) -> np.ndarray:
    """Scales of the prior of the strength ``p``, evenly in the logarithm."""
    return np.geomspace(p.step, max(abs(p.lower), abs(p.upper)), STRENGTH_SCALES)


PREDICTIVE_DRAWS = 400
"""Draws from which the posterior predictive probability is estimated."""


def predictive_p(evidence: Evidence, linear: LinearModel, terms: Sequence[EffectTerm], seed: int = 0) -> float:
    """Probability of a residual as large as that of the model, if nothing is missing and the errors are as expected (prior
    predictive check; Box, J. R. Stat. Soc. A 143, 1980).

    Residuals are compared after the fit that takes errors for what is expected of them. The modes of a draw are as
    dependent on each other as those of the residual (``Evidence.weight``).
    """
    blocks, priors = evidence.blocks(linear), evidence.priors(linear, terms)
    sizes = SizePriors.of(blocks)
    covariances = [BlockCovariance(b) for b in blocks]
    expected = [np.linalg.cholesky(c(sizes.mean)) for c in covariances]
    columns = np.concatenate([_white(f, b.jacobian) for f, b in zip(expected, blocks, strict=True)])
    columns = np.concatenate([columns, np.diag(np.sqrt(priors.precision[0]))])
    basis = np.linalg.qr(columns)[0][: -columns.shape[1] or None] if columns.shape[1] else columns

    def size(residuals: Sequence[np.ndarray]) -> float:
        white = np.concatenate([_white(f, r) for f, r in zip(expected, residuals, strict=True)])
        return float((white**2).sum() - ((basis.T @ white) ** 2).sum())

    observed = size([b.residual for b in blocks])
    rng = np.random.default_rng(seed)
    larger = 0
    for _ in range(PREDICTIVE_DRAWS):
        logs = sizes.mean + sizes.sd * rng.normal(size=len(sizes.mean))
        drawn = []
        for b, c in zip(blocks, covariances, strict=True):
            modes = b.residual.shape[1]
            count = max(1, round(modes * evidence.weight))
            series = np.linalg.cholesky(c(logs)) @ rng.normal(size=(len(b.lags), count))
            directions = np.linalg.qr(rng.normal(size=(modes, count)))[0]
            drawn.append(series @ directions.T * math.sqrt(modes / count))
        larger += size(drawn) >= observed
    return (larger + 1) / (PREDICTIVE_DRAWS + 1)


def _white(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients (T, K, ...) whitened and flat, (T K, ...)."""
    white = np.linalg.solve(factor, values.reshape(len(values), -1))
    return white.reshape(-1, *values.shape[2:])
