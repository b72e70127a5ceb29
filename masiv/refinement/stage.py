"""The stage: residual -> ranked effects -> joint refits -> what the evidence confirms."""

from __future__ import annotations

from collections.abc import Sequence

from masiv.effects.catalogue import effect_named
from masiv.inference.model_fit import ModelFit
from masiv.models.base import ForwardModel
from masiv.refinement.config import RefineConfig
from masiv.refinement.result import RefineResult
from masiv.refinement.search import search_effects
from masiv.refinement.search_state import SearchSettings


def refine(
    forward_model: ForwardModel,
    baselines: Sequence[ModelFit],
    settings: SearchSettings,
    *,
    condition: str | None = None,
) -> RefineResult:
    """Which effects does the model of ``forward_model``'s observations lack?

    baselines: fits without those effects, one a law; none of the arguments is changed. condition: of the observations,
    for the result. Raises InputError for an unknown effect in ``config.effects`` and for two observations of one name,
    MasivError if no baseline can be simulated.
    """
    check_effects(settings.config)
    names = [e.name for e in forward_model.observations]
    if len(set(names)) < len(names):
        # Parameters are named after their observation.
        raise ValueError(f"observations need names that differ: {', '.join(names)}")
    search = search_effects(forward_model, baselines, settings)
    return RefineResult(search, settings.config, settings.rank_only, condition=condition)


def check_effects(config: RefineConfig) -> None:
    """Raises InputError for a name in ``config.effects`` that is not in the library."""
    for name in config.effects:
        effect_named(name)
