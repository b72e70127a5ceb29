"""What is evidence for an effect: residuals against what noise and discretization could do, and held-out data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import NoiseModel
from masiv.inference.significance import wald_z_gls
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.config import RefineConfig

NEGLIGIBLE_VARIANCE_RATIO = 0.25
"""Variance over that of noise and discretization below which a difference of two fits is not significant."""


def above_noise(fitted: ModelFit, noise: NoiseModel, config: RefineConfig) -> bool:
    """Whether the residual of the fitted instants is above the noise of the observation, or that of the held-out ones
    above what noise and discretization explain: what law and initial state make up for at first shows there."""
    squares = np.concatenate(
        [(s / e.noise_std**2)[: e.fit_count] for s, e in zip(fitted.squares, noise.observations, strict=True)]
    )
    rest = noise.held_out(fitted.squares)
    explained = not len(rest) or math.sqrt(float(rest.mean())) <= config.max_reduced_chi
    return math.sqrt(float(squares.mean())) > config.noise_threshold or not explained


def simplest(best_first: Sequence[ModelFit], noise: NoiseModel, *, held_out: bool = False) -> ModelFit | None:
    """Of fits, best first, the one with the fewest parameters (those held at a guess included) that explains what the
    best one does, but for less than noise and discretization could change. held_out: of the held-out instants, too."""

    def lacks(fitted: ModelFit) -> float:
        excess = [mine - best for mine, best in zip(fitted.squares, best_first[0].squares, strict=True)]
        largest = noise.by_regime(noise.over_variance(excess)).largest
        if not held_out or not any(e.holds_out for e in noise.observations):
            return largest
        rest = noise.held_out(fitted.squares) - noise.held_out(best_first[0].squares)
        return max(largest, float(rest.mean()))

    sufficient = (f for f in best_first if lacks(f) < NEGLIGIBLE_VARIANCE_RATIO)
    return min(sufficient, key=lambda f: len(f.values), default=None)


def select_by_validation(fits: Sequence[ModelFit], noise: NoiseModel) -> ModelFit:
    """Of fits of several laws, the simplest that explains fitted and held-out instants about as well as the best."""
    best_first = sorted(fits, key=lambda f: total_chi_square(f, noise))
    return simplest(best_first, noise, held_out=True) or best_first[0]


def total_chi_square(fitted: ModelFit, noise: NoiseModel) -> float:
    """Sum of mean squares over variances, fitted and held-out instants alike."""
    return sum(float(ratio.sum()) for ratio in noise.over_variance(fitted.squares))


def objections_to(
    forward_model: ForwardModel, before: ModelFit, after: ModelFit, term: EffectTerm, config: RefineConfig
) -> list[str]:
    """Why ``term``, by which ``after`` is richer than ``before``, is not accepted; empty if it is."""
    noise = NoiseModel(forward_model.observations)
    general = statistical_objections(before, after, term, noise, config)
    return [*general, *forward_model.objections(before, after, term, config.min_gain)]


def statistical_objections(
    before: ModelFit, after: ModelFit, term: EffectTerm, noise: NoiseModel, config: RefineConfig
) -> list[str]:
    """What the data says against ``term``; empty if nothing."""
    out = []
    gain = after.bic_gain(before)
    fall = gain + log_predictive_gain(before, after, noise)
    if fall < config.min_bic_gain:
        out.append(f"the information criterion falls by {fall:.1f}, less than {config.min_bic_gain:g}")
    adapts = len(term.parameters) > 1 or gain < config.clear_bic_gain
    out += too_little_explained(
        before, after, noise, config, adapts=adapts, gls_z=lambda: wald_z_gls(after, term, noise)
    )
    z = strength_z(after, term)
    if not z >= config.min_strength_z:
        out.append(f"its strength is {z:.1f} standard errors from zero, less than {config.min_strength_z:g}")
    return out + parameters_at_bounds(after, term)


def parameters_at_bounds(after: ModelFit, term: EffectTerm) -> list[str]:
    """Which parameters of ``term`` ran into the bound of what is possible, as objections."""
    # What acts on the matter at a place may well be at the body's face, where its place ends.
    bounded = term.strengths if effect_named(term.effect).hints.inside else term.parameters
    return [
        f"{p.name} runs into the bound of what is possible, {p.upper:g}"
        for p in bounded
        if after.values[p.name] >= p.upper - 1e-9 * abs(p.upper)
    ]


def strength_z(fitted: ModelFit, term: EffectTerm) -> float:
    """How many standard errors the strength of ``term`` is from zero, its places and frequencies held.

    A strength and a place may make up for each other (a lighter mass farther out), so that neither is well known
    although something is there. ``ModelFit.stderr`` is of each with all else free.
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
        ratio = math.sqrt(fixed[kept.index(k)] / free[k]) if free[k] > 0 else 1.0
        total += (fitted.values[p.name] / (fitted.stderr[p.name] * ratio)) ** 2
    return math.sqrt(total)


def too_little_explained(
    before: ModelFit, after: ModelFit, noise: NoiseModel, config: RefineConfig,
    *, adapts: bool = True, gls_z: Callable[[], float | None] = lambda: None,
) -> list[str]:  # fmt: skip
    """What fitted and held-out instants say against ``after``; empty if one of three kinds of evidence is there.

    - A part of the held-out error, the larger (``min_gain`` to ``decisive_gain``) the less is explained of what noise
      and discretization could change in the fitted instants.
    - Held-out instants that do not contradict, and a decisive part of the observation-limited ones. ``gls_z``: standard
      deviations of the effect under smooth noise, worked out if that decides.
    - A smaller part of the held-out error (``min_gain`` to ``single_parameter_gain``), for an effect that cannot adapt
      to an error of any shape: ``adapts`` is False for one parameter and a clear criterion. Not a much smaller one: a
      body at rest keeps its error, and held-out instants then repeat what the last fitted ones said.
    """
    gained = [b - a for b, a in zip(before.squares, after.squares, strict=True)]
    fitted = noise.by_regime(noise.over_variance(gained))
    share = fitted.largest
    little = f"it explains {max(share, 0.0):.2g} of what noise and a finer grid alone could change"
    was, now = noise.held_out(before.squares), noise.held_out(after.squares)
    if not len(was):
        return [] if share >= 1 else [little]
    won, removed = was - now, rms_reduction(was, now)
    unsure = 1 - min(max(share, 0.0), 1.0)
    most = config.decisive_gain if adapts else config.single_parameter_gain
    asked = config.min_gain + (most - config.min_gain) * unsure
    if share > 0 and removed >= asked and (not adapts or won.mean() >= NEGLIGIBLE_VARIANCE_RATIO):
        return []
    limited = fitted.observation_limited
    if limited is not None and won.mean() > -1 and _decisive(limited, config, gls_z):
        return []
    there = (
        f"it removes {100 * removed:.0f} % of the held-out error (asked: {100 * asked:.0f} %), "
        f"{max(float(won.mean()), 0.0):.2g} of what noise and a finer grid alone could change there"
    )
    return [little] * (share < 1) + [there]


def _decisive(variance_ratio: float, config: RefineConfig, gls_z: Callable[[], float | None]) -> bool:
    """Whether the variance that is explained in observation-limited instants, over the noise's, is enough if held-out
    instants do not contradict; less is enough if noise as smooth as the residual does not look like the effect
    (``gls_z``, which takes seconds)."""
    if variance_ratio >= config.decisive_variance_ratio or variance_ratio < 1:
        return variance_ratio >= config.decisive_variance_ratio
    z = gls_z()
    return z is not None and z >= config.min_gls_z


def log_predictive_gain(before: ModelFit, after: ModelFit, noise: NoiseModel) -> float:
    """By how much more the information criterion falls for what no fit saw (Dawid's prequential likelihood, J. R. Stat.
    Soc. A 147, 1984). The held-out instants of an observation are one sample, since they share one error that grows; of
    an error within noise and discretization there is nothing to predict."""
    out = 0.0
    ratios = zip(
        noise.over_variance(before.squares), noise.over_variance(after.squares), noise.observations, strict=True
    )
    for was, now, e in ratios:
        if e.holds_out:
            was, now = (max(float(r[e.fit_count :].mean()), 1.0) for r in (was, now))
            out += math.log(was / now)
    return out


def rms_reduction(was: np.ndarray, now: np.ndarray) -> float:
    """Part of a root mean square that is gone, of squares before and after."""
    return 1 - math.sqrt(float(now.sum()) / max(float(was.sum()), 1e-300))
