"""The evidence for models of the same observations: their marginal likelihoods over all instants."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.inference.error_covariance import BlockCovariance, ErrorBlock
from masiv.inference.linear_model import LinearModel
from masiv.inference.marginal_likelihood import Marginal, ParameterPriors, SizePriors, marginal
from masiv.inference.motion_modes import MotionModes, rotations_since_start
from masiv.inference.noise_model import OBSERVATION_LIMITED_RATIO
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
MIN_SEGMENT = 2
"""Instants of a segment, at the least."""
MIN_SERIES = 0.1
"""Independent series of a group that moves with others, at the least."""
MAX_INSTANTS = 256
"""A longer record is thinned to as many."""
DIFFERENCES, DIFFERENCE_VARIANCE = 3, 20.0
"""Third differences leave little of a smooth motion; those of independent values have 20 times their variance."""
CHI2_MEDIAN = 0.4549
"""Median of the square of a standard normal variable."""


@dataclass(frozen=True)
class _Segment:
    """Instants of an observation in modes of motion: those that are observation-limited, or those from the first on
    that is not, in which errors of the simulation move all modes together.

    kept: instants (T,); turned: see ``MotionModes.coefficients``. jitter (G,) [m]: expected jitter of a coefficient;
    smooth (T,) [m]: expected smooth error of a point along an axis; grid: of each group, (T,) [m] by which another grid
    may change a coefficient; weights (G,): powers of the likelihood of each group; first_group: number of groups of
    other kinds of segments.
    """

    index: int
    observation: Observation
    modes: MotionModes
    kept: np.ndarray
    turned: np.ndarray | None
    jitter: tuple[float, ...]
    smooth: np.ndarray
    grid: tuple[np.ndarray, ...]
    weights: tuple[float, ...]
    first_group: int

    @classmethod
    def of(cls, index: int, observation: Observation, field: np.ndarray) -> list[_Segment]:
        """Of observation number ``index``. field (T, N, A) [m]: the residual of the best model."""
        count, axes = field.shape[1:]
        modes = MotionModes.of(observation.points, axes)
        stride = math.ceil(len(field) / MAX_INSTANTS)
        seen = np.isfinite(observation.values).any(axis=(1, 2))
        kept = np.flatnonzero(seen)[::stride]
        turned = None
        if axes == 3 and count >= MIN_TURNED_POINTS:
            positions = np.where(np.isfinite(observation.values), observation.values, observation.points)
            turned = rotations_since_start(observation.points, positions[kept].astype(np.float64))
        grid = _grid_changes(observation, modes, kept, turned)
        known = observation.observation_std[kept] / math.sqrt(axes)
        floor = float(known.min()) / math.sqrt(count)
        jitter = tuple(jitter_of(c) or floor for c in modes.coefficients(field[kept], turned))
        smooth = np.full(len(kept), jitter[0]) if count == 1 else known
        limited = observation.residual_std[kept] < OBSERVATION_LIMITED_RATIO * observation.noise_std
        split = len(kept) if limited.all() or not observation.grid_corrections else int(np.argmin(limited))
        out = []
        for late, part in ((False, slice(0, split)), (True, slice(split, None))):
            if len(kept[part]) < MIN_SEGMENT:
                continue
            own = None if turned is None else turned[part]
            parts = modes.coefficients(field[kept[part]], own)
            out.append(
                cls(
                    index, observation, modes, kept[part], own, jitter, smooth[part], tuple(g[part] for g in grid),
                    _weights(parts, together=late), len(modes.names) if late else 0,
                )
            )  # fmt: skip
        return out

    def blocks(self, field: np.ndarray, jacobian: np.ndarray) -> list[ErrorBlock]:
        """Of a residual field (T, N, A) [m] and its derivatives (T, N, A, P)."""
        times = self.observation.times[self.kept]
        lags = np.abs(np.subtract.outer(times, times))
        residuals = self.modes.coefficients(field[self.kept], self.turned)
        jacobians = self.modes.coefficients(jacobian[self.kept], self.turned)
        groups = len(self.modes.names)
        return [
            ErrorBlock(
                residual, derivatives, lags, self.first_group + group, self.jitter[group],
                self.smooth * math.sqrt(self.modes.axes / (residual.shape[1] * groups)), self.grid[group],
                GRID_CORRELATION * float(self.observation.times[-1]), self.weights[group],
            )
            for group, (residual, derivatives) in enumerate(zip(residuals, jacobians, strict=True))
        ]  # fmt: skip


def _weights(residuals: Sequence[np.ndarray], *, together: bool) -> tuple[float, ...]:
    """Powers of the likelihoods of groups whose ``residuals`` are (T, K_g): the part of their series that is
    independent of others in the group; ``together``: and of the groups before, the first of which is the mean
    motion."""
    series = [independent_series(r) for r in residuals]
    if together:
        known = 0.0
        for k in range(len(series)):
            whole = max(independent_series(np.concatenate(residuals[: k + 1], axis=1)), known)
            series[k] = min(series[k], max(whole - known, MIN_SERIES))
            known = whole
    return tuple(s / r.shape[1] for s, r in zip(series, residuals, strict=True))


def independent_series(residual: np.ndarray) -> float:
    """How many independent series the coefficients (T, K) of a residual are worth, of K: the participation ratio of
    their covariance over the modes, corrected for how few instants show it.

    What a simulation lacks moves all modes together: then they are one series, not K.
    """
    instants, count = residual.shape
    power = np.linalg.svd(residual, compute_uv=False) ** 2
    if power.sum() == 0.0:
        return float(count)
    inverse = float((power**2).sum() / power.sum() ** 2) - 1 / instants
    return 1 / max(inverse, 1 / count)


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


@dataclass(frozen=True)
class Evidence:
    """Works out the evidence of models of ``observations``, with one expectation of errors for all of them."""

    observations: Sequence[Observation]
    segments: tuple[_Segment, ...]

    @classmethod
    def of(cls, observations: Sequence[Observation], fields: Sequence[np.ndarray]) -> Evidence:
        """fields: the residual of the best model at all instants."""
        pairs = enumerate(zip(observations, fields, strict=True))
        segments = [segment for k, (e, f) in pairs for segment in _Segment.of(k, e, f)]
        used = sorted({s.first_group for s in segments})
        if used == [len(segments[0].modes.names)]:  # no instant is observation-limited
            segments = [replace(s, first_group=0) for s in segments]
        return cls(tuple(observations), tuple(segments))

    def marginal(self, linear: LinearModel, terms: Sequence[EffectTerm]) -> Marginal:
        """The marginal likelihood of a model with the effects ``terms``."""
        return self.marginal_with(linear, self.priors(linear, terms))

    def marginal_with(self, linear: LinearModel, priors: ParameterPriors) -> Marginal:
        """The same with other ``priors`` of its parameters."""
        blocks = self.blocks(linear)
        return marginal(blocks, priors, SizePriors.of(blocks))

    def blocks(self, linear: LinearModel) -> list[ErrorBlock]:
        """Of all observations; columns are the model's parameters, then the nuisance of each observation."""
        widths = [n.shape[-1] for n in linear.nuisance]
        out = []
        for segment in self.segments:
            k = segment.index
            own = [
                linear.nuisance[j] if j == k else np.zeros((*linear.fields[k].shape, widths[j]))
                for j in range(len(self.observations))
            ]
            out += segment.blocks(linear.fields[k], np.concatenate([linear.jacobians[k], *own], axis=-1))
        return out

    def priors(self, linear: LinearModel, terms: Sequence[EffectTerm]) -> ParameterPriors:
        """Strengths: a mixture of normal densities about zero. All others: flat, over the range that is possible and
        that this recording could show."""
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
    """Probability of a residual as large as that of the model, if nothing is missing and the errors are as expected
    (prior predictive check; Box, J. R. Stat. Soc. A 143, 1980).

    Residuals are compared after the fit that takes errors for what is expected of them. The modes of a draw are as
    dependent on each other as those of the residual.
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
            count = max(1, round(modes * b.weight))
            series = np.linalg.cholesky(c(logs)) @ rng.normal(size=(len(b.lags), count))
            directions = np.linalg.qr(rng.normal(size=(modes, count)))[0]
            drawn.append(series @ directions.T * math.sqrt(modes / count))
        larger += size(drawn) >= observed
    return (larger + 1) / (PREDICTIVE_DRAWS + 1)


def _white(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients (T, K, ...) whitened and flat, (T K, ...)."""
    white = np.linalg.solve(factor, values.reshape(len(values), -1))
    return white.reshape(-1, *values.shape[2:])
