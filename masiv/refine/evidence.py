"""What is evidence that a model lacks an effect: residuals against what noise and grid could do, and held-out data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.inference.model_fit import ModelFit
from masiv.inference.significance import observation_limited, wald_z_gls
from masiv.models.base import EffectTerm, Observation
from masiv.refine.config import RefineConfig

SIMPLER = 0.25
"""Variance, over that of noise and grid, that tells nothing."""


@dataclass(frozen=True)
class ReducedChi:
    """Means over fitted instants: those that are simulated as well as they are observed, and the others. None: there
    are none of that kind."""

    certain: float | None
    uncertain: float | None

    @property
    def largest(self) -> float:
        return max(mean for mean in (self.certain, self.uncertain) if mean is not None)


def reduced_chi_by_regime(ratios: Sequence[np.ndarray], observations: Sequence[Observation]) -> ReducedChi:
    """Of ``ratios`` (K,) of each experiment over its instants."""
    certain, uncertain = [], []
    for ratio, e in zip(ratios, observations, strict=True):
        known = observation_limited(e)
        certain.append(ratio[: e.fit_count][known])
        uncertain.append(ratio[: e.fit_count][~known])
    means = (float(part.mean()) if len(part) else None for part in map(np.concatenate, (certain, uncertain)))
    return ReducedChi(*means)


def reduced_chi(fitted: ModelFit, observations: Sequence[Observation]) -> float:
    """Root mean square residual over the fitted instants in units of sigma, in the phase of the motion (well known, or
    not) where it is largest: about 1 where nothing is missing."""
    ratios = [s / e.residual_std**2 for s, e in zip(fitted.squares, observations, strict=True)]
    return math.sqrt(reduced_chi_by_regime(ratios, observations).largest)


def above_noise(fitted: ModelFit, observations: Sequence[Observation], config: RefineConfig) -> bool:
    """Whether the residual over the fitted instants is above the noise of the observation, or that over the held-out
    ones above what noise and grid explain: what a law and a throw make up for at first shows there."""
    squares = np.concatenate(
        [(s / e.noise_std**2)[: e.fit_count] for s, e in zip(fitted.squares, observations, strict=True)]
    )
    rest = held_out(fitted, observations)
    explained = not len(rest) or math.sqrt(float(rest.mean())) <= config.unexplained
    return math.sqrt(float(squares.mean())) > config.above_noise or not explained


def simplest(
    passing: Sequence[ModelFit], observations: Sequence[Observation], *, whole: bool = False
) -> ModelFit | None:
    """Of fits, best first, the one with the fewest parameters (those held at a guess included) that explains what the
    best one does, but for less than noise and grid could change. whole: of the held-out instants, too."""

    def lacks(fitted: ModelFit) -> float:
        squares = zip(fitted.squares, passing[0].squares, observations, strict=True)
        largest = reduced_chi_by_regime(
            [(mine - best) / e.residual_std**2 for mine, best, e in squares], observations
        ).largest
        if not whole or not any(e.holds_out for e in observations):
            return largest
        return max(largest, float((held_out(fitted, observations) - held_out(passing[0], observations)).mean()))

    return min((f for f in passing if lacks(f) < SIMPLER), key=lambda f: len(f.values), default=None)


def objections(
    before: ModelFit, after: ModelFit, term: EffectTerm, observations: Sequence[Observation], config: RefineConfig
) -> list[str]:
    """Why ``term`` is not accepted; empty where it is."""
    out = []
    gain = before.bic(after.samples) - after.bic(after.samples)
    fall = gain + log_predictive_gain(before, after, observations)
    if fall < config.least_bic:
        out.append(f"the information criterion falls by {fall:.1f}, less than {config.least_bic:g}")
    adapts = len(term.parameters) > 1 or gain < config.clear_bic
    out += explains_too_little(
        before, after, observations, config, adapts=adapts, sure=lambda: wald_z_gls(after, term, observations)
    )  # fmt: skip
    sigmas = sigmas_from_zero(after, term)
    if not sigmas >= config.least_sigmas:
        out.append(f"its strength is {sigmas:.1f} standard errors from zero, less than {config.least_sigmas:g}")
    return out + beyond_possible(after, term)


def beyond_possible(after: ModelFit, term: EffectTerm) -> list[str]:
    """Which parameters of ``term`` ran into the bound of what is possible, as objections."""
    # What acts on the matter at a place may well be at the body's face, where its place ends.
    bounded = term.strengths if effect_named(term.effect).hints.inside else term.parameters
    return [
        f"{p.name} runs into the bound of what is possible, {p.upper:g}"
        for p in bounded
        if after.values[p.name] >= p.upper - 1e-9 * abs(p.upper)
    ]


def sigmas_from_zero(fitted: ModelFit, term: EffectTerm) -> float:
    """How many standard errors the strength of ``term`` is from none, its places and frequencies held where they are.

    A strength and a place may make up for each other (a lighter mass farther out), so that neither is well known
    while it is plain that something is there. ``ModelFit.stderr`` is of each with all else free.
    """
    held = {p.name for p in term.others}
    lengths = np.maximum(np.linalg.norm(fitted.jacobian, axis=0), 1e-300)
    unit = fitted.jacobian / lengths
    names = [p.name for p in fitted.parameters]
    kept = [k for k, name in enumerate(names) if name not in held]
    free, fixed = (np.diag(np.linalg.pinv(a.T @ a, hermitian=True)) for a in (unit, unit[:, kept]))
    total = 0.0
    for p in term.strengths:
        k = names.index(p.name)
        known = math.sqrt(fixed[kept.index(k)] / free[k]) if free[k] > 0 else 1.0
        total += (fitted.values[p.name] / (fitted.stderr[p.name] * known)) ** 2
    return math.sqrt(total)


def explains_too_little(
    before: ModelFit, after: ModelFit, observations: Sequence[Observation], config: RefineConfig,
    *, adapts: bool = True, sure: Callable[[], float | None] = lambda: None,
) -> list[str]:  # fmt: skip
    """What fitted and held-out instants, weighted alike, say against ``after``.

    Three kinds of evidence are enough: a part of the held-out error that is the larger (``least_gain`` to
    ``decisive_gain``) the less is explained of what noise and grid could change in the fitted instants; held-out
    instants that do not contradict, and a motion that is plain where the simulation is as certain as the observation
    (sure: how many sigmas the effect is from none beside a smooth noise, worked out where that decides); or a smaller
    part of the held-out error (``least_gain`` to ``simple_gain``), for an effect that cannot adapt to an error of any
    shape (``adapts`` False: it is one number, and the criterion is clear). Not a much smaller one: a body at rest keeps
    its error, and held-out instants then repeat what the last fitted ones said.
    """
    # Variance that it removes, over that which noise and grid would explain.
    gained = [(b - a) / e.residual_std**2 for b, a, e in zip(before.squares, after.squares, observations, strict=True)]
    fitted = reduced_chi_by_regime(gained, observations)
    share = fitted.largest
    little = f"it explains {max(share, 0.0):.2g} of what noise and a finer grid alone could change"
    was, now = held_out(before, observations), held_out(after, observations)
    if not len(was):
        return [] if share >= 1 else [little]
    won, removed = was - now, removed_of(was, now)
    unsure = 1 - min(max(share, 0.0), 1.0)
    asked = config.least_gain + ((config.decisive_gain if adapts else config.simple_gain) - config.least_gain) * unsure
    if share > 0 and removed >= asked and (not adapts or won.mean() >= SIMPLER):
        return []
    if fitted.certain is not None and won.mean() > -1 and _plain(fitted.certain, config, sure):
        return []
    there = (
        f"it removes {100 * removed:.0f} % of the held-out error (asked: {100 * asked:.0f} %), "
        f"{max(float(won.mean()), 0.0):.2g} of what noise and a finer grid alone could change there"
    )
    return [little] * (share < 1) + [there]


def held_out(fitted: ModelFit, observations: Sequence[Observation]) -> np.ndarray:
    """Squares over those of noise and grid at the held-out instants of all ``observations``."""
    parts = [
        (squares / e.residual_std**2)[e.fit_count :]
        for squares, e in zip(fitted.squares, observations, strict=True)
        if e.holds_out
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


def log_predictive_gain(before: ModelFit, after: ModelFit, observations: Sequence[Observation]) -> float:
    """By how much more the information criterion falls for what no fit saw (Dawid's prequential likelihood, J. R. Stat.
    Soc. A 147, 1984). The held-out instants of an experiment are one sample, since they share one error that grows; of
    an error within noise and grid there is nothing to foretell."""
    out = 0.0
    for was, now, e in zip(before.squares, after.squares, observations, strict=True):
        if e.holds_out:
            was, now = (max(float((s / e.residual_std**2)[e.fit_count :].mean()), 1.0) for s in (was, now))
            out += math.log(was / now)
    return out


def all_instants(fitted: ModelFit, observations: Sequence[Observation]) -> float:
    """Sum of squares over those of noise and grid, fitted and held-out instants alike."""
    return sum(float((s / e.residual_std**2).sum()) for s, e in zip(fitted.squares, observations, strict=True))


def select_by_validation(fits: Sequence[ModelFit], observations: Sequence[Observation]) -> ModelFit:
    """Of fits of several laws, the simplest that explains fitted and held-out instants about as well as the best."""
    best_first = sorted(fits, key=lambda f: all_instants(f, observations))
    return simplest(best_first, observations, whole=True) or best_first[0]


def removed_of(was: np.ndarray, now: np.ndarray) -> float:
    """Share of a root mean square that is gone, of squares before and after."""
    return 1 - math.sqrt(float(now.sum()) / max(float(was.sum()), 1e-300))


def _plain(gained: float, config: RefineConfig, sure: Callable[[], float | None]) -> bool:
    """Whether the variance that is ``gained`` in free flight, over the noise's, is enough where held-out instants do
    not contradict; less is where noise as smooth as what is left does not look like the cause (``sure``, which takes
    seconds)."""
    if gained >= config.decisive or gained < 1:
        return gained >= config.decisive
    sigmas = sure()
    return sigmas is not None and sigmas >= config.plain_sigmas
