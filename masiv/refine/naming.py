"""Which of the causes that were tried is named, and which others the data does not tell from it."""

from __future__ import annotations

from collections.abc import Sequence

from masiv.refine.certainty import told_apart
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import all_instants, foretelling, simplest
from masiv.refine.rounds import TELLS_APART, Trial
from masiv.refine.simulated import Watched


def named(
    trials: Sequence[Trial], experiments: Sequence[Watched], config: RefineConfig
) -> tuple[Trial | None, list[str]]:
    """The trial to accept, None where none passes, and the effects that may as well be what is there.

    trials: best first by the information criterion. Of those that pass, the simplest that explains what the best one
    does; and with it, each that is no richer (or so much better that this pays) and explains the motion about as well
    as the best (``told_apart``). Of all these the one that explains all instants best, fitted and held out, is named,
    beside the simplest law that foretells about as well as the best of its laws does.
    """
    passing = [t for t in trials if t.passes]
    fit = simplest([t.fitted for t in passing], experiments)
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
        sigmas = told_apart(best, trial.fitted, experiments)
        if sigmas < config.least_apart if sigmas is not None else gain > -TELLS_APART:
            group.append(trial)
    first = min(group, key=lambda t: all_instants(t.fitted, experiments))
    of_it = [t for t in passing if t.candidate.effect == first.candidate.effect]
    law = foretelling([t.fitted for t in of_it], experiments)
    return next(t for t in of_it if t.fitted is law), [t.candidate.effect for t in group if t is not first]
