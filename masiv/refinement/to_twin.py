"""A twin with what refine accepted."""

from __future__ import annotations

from masiv.identification.from_tracks import errors_mm
from masiv.inference.model_fit import ModelFit
from masiv.refinement.result import RefineResult
from masiv.simulation.fitted_twin import fitted_twin
from masiv.twin import Twin


def refined_twin(twin: Twin, result: RefineResult) -> Twin:
    """``twin``, as it is to be refined, with the law, starts, boundary and effects that ``result`` accepted; ``twin``
    itself if nothing was."""
    return _with_fit(twin, result.twin_fit, result) if result.changes_twin else twin


def baseline_twin(twin: Twin, result: RefineResult) -> Twin:
    """``twin`` with the model that effects are compared with, the best one without them."""
    return _with_fit(twin, result.before, result)


def _with_fit(twin: Twin, fitted: ModelFit, result: RefineResult) -> Twin:
    return fitted_twin(twin, fitted, result.forward_model, {**twin.fit, "refined": errors_mm(fitted)})
