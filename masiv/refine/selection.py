"""Which of the causes that were tried is named, and which others the data does not tell from it."""

from __future__ import annotations

from collections.abc import Sequence

from masiv.inference.significance import vuong_z
from masiv.models.base import Observation
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import all_instants, select_by_validation, simplest
from masiv.refine.rounds import TELLS_APART, Trial


def named(
    trials: Sequence[Trial], observations: Sequence[Observation], config: RefineConfig
) -> tuple[Trial | None, list[str]]:
    """The trial to accept, None where none passes, and the effects that may as well be what is there.

    trials: best first by the information criterion. Of those that pass, the simplest that explains what the best one
    does; and with it, each that is no richer (or so much better that this pays) and explains the motion about as well
    as the best (``vuong_z``). Of all these the one that explains all instants best, fitted and held out, is named,
    beside the simplest law that foretells about as well as the best of its laws does.
    """
    passing = [t for t in trials if t.passes]
    fit = simplest([t.fitted for t in passing], observations)
    if fit is None:
        return None, []
    best, chosen = passing[0].fitted, next(t for t in passing if t.fitted is fit)
    group = [chosen]
    for trial in passing:
        if trial.candidate.effect in {t.candidate.effect for t in group}:
            continue
        gain = fit.bic(best.samples) - trial.fitted.bic(best.samples)
        if len(trial.fitted.values) > len(fit.values) and gain < TELLS_APART:
            continue
        sigmas = vuong_z(best, trial.fitted, observations)
        if sigmas < config.least_apart if sigmas is not None else gain > -TELLS_APART:
            group.append(trial)
    first = min(group, key=lambda t: all_instants(t.fitted, observations))
    of_it = [t for t in passing if t.candidate.effect == first.candidate.effect]
    law = select_by_validation([t.fitted for t in of_it], observations)
    return next(t for t in of_it if t.fitted is law), [t.candidate.effect for t in group if t is not first]
