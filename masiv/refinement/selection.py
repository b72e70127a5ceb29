"""Which of the effects that were tried is named, and which others the data does not distinguish from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import NoiseModel
from masiv.inference.significance import vuong_z
from masiv.refinement.config import RefineConfig
from masiv.refinement.evidence import select_by_validation, simplest, total_chi_square
from masiv.refinement.rounds import MIN_BIC_GAP, Trial


@dataclass(frozen=True)
class Selection:
    """trial: the one to accept, None if none passes; indistinguishable_from: effects that may as well be there."""

    trial: Trial | None = None
    indistinguishable_from: tuple[str, ...] = ()


def select(best_first: Sequence[Trial], noise: NoiseModel, config: RefineConfig) -> Selection:
    """Of trials, best first by the information criterion, one of those that pass.

    The *credible* ones are the simplest that explains what the best one does, and each that is no richer (or so much
    better that this pays) and explains the motion about as well as the best. Of these the effect that explains all
    instants best, fitted and held out, is named, with the simplest law that predicts about as well as the best of its
    laws does.
    """
    passing = [t for t in best_first if t.passes]
    credible = _credible(passing, noise, config)
    if not credible:
        return Selection()
    first = min(credible, key=lambda t: total_chi_square(t.fitted, noise))
    same_effect = [t for t in passing if t.effect == first.effect]
    law = select_by_validation([t.fitted for t in same_effect], noise)
    trial = next(t for t in same_effect if t.fitted is law)
    return Selection(trial, tuple(t.effect for t in credible if t is not first))


def _credible(passing: Sequence[Trial], noise: NoiseModel, config: RefineConfig) -> list[Trial]:
    simple = simplest([t.fitted for t in passing], noise)
    if simple is None:
        return []
    best = passing[0].fitted
    out = [next(t for t in passing if t.fitted is simple)]
    for trial in passing:
        if trial.effect in {t.effect for t in out}:
            continue
        gain = simple.bic(best.samples) - trial.fitted.bic(best.samples)
        if len(trial.fitted.values) > len(simple.values) and gain < MIN_BIC_GAP:
            continue
        if not _distinguished(best, trial, gain, noise, config):
            out.append(trial)
    return out


def _distinguished(best: ModelFit, trial: Trial, gain: float, noise: NoiseModel, config: RefineConfig) -> bool:
    """Whether the data distinguishes ``trial`` from the ``best`` fit: by Vuong's test, or without it by ``gain``,
    the fall of the information criterion from the simplest fit."""
    z = vuong_z(best, trial.fitted, noise)
    return z >= config.min_vuong_z if z is not None else gain <= -MIN_BIC_GAP
