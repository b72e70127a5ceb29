"""A twin with what refine accepted."""

from __future__ import annotations

import math
from dataclasses import replace

from masiv.identify.from_tracks import errors_mm
from masiv.identify.tracks import conditions
from masiv.inference.model_fit import ModelFit
from masiv.models.clamped_body import BodySimulation
from masiv.models.families import law_of
from masiv.models.free_body import Simulation, effect_parameters, initial_state_of
from masiv.refine.result import RefineResult
from masiv.tracks.tracks import Tracks
from masiv.tracks.twin import TracksTwin, found_effect, law_parameters, starts_of
from masiv.twin import Twin, TwinEffect


def twin_of(fitted: ModelFit, forward_model: Simulation, old: Twin) -> Twin:
    """``old`` with the law, initial state, ground and effects of ``fitted``; those of the first recording."""
    observation = forward_model.observations[0]
    motion = initial_state_of(fitted.values, observation)
    axes = observation.problem.axes
    law = law_of(fitted.model.family, fitted.values)
    law.stderr = {n: fitted.stderr[n] for n in law.values if math.isfinite(fitted.stderr.get(n, math.inf))}
    effects = tuple(
        TwinEffect(
            name,
            {p.name.split(".")[1]: fitted.values[p.name] for p in effect_parameters(name)},
            {p.name.split(".")[1]: _known(fitted.stderr.get(p.name, math.inf)) for p in effect_parameters(name)},
        )
        for name in fitted.model.effects
    )
    return replace(
        old,
        velocity=axes.vectors_to_world(motion.velocity.double().numpy()),
        omega=axes.vectors_to_world(motion.omega.double().numpy()),
        ground=motion.ground(observation.problem.scene.ground),
        contact=fitted.model.contact,
        law=law,
        effects=effects,
        fit={**old.fit, "refined": errors_mm(fitted)},
    )


def _known(error: float) -> float | None:
    return error if math.isfinite(error) else None


def starting_twin(identified: TracksTwin, current: TracksTwin, tracks: Tracks, condition: str | None) -> TracksTwin:
    """The twin from which runs of ``condition`` (None: the first) are refined: as if they never had been.

    identified: as identify made it; current: with what refine accepted since. In the first condition the law is that of
    ``identified``; in others law and effects of the first are as ``current`` has them.
    """
    if identified.group is not None:
        return identified
    first = conditions(tracks)[0]
    own = first if condition is None else condition
    runs = {run.name for run in tracks.runs if run.condition == own}
    starts = {n: v for n, v in current.starts.items() if n.split("@", 1)[1] not in runs}
    others = tuple(e for e in current.effects if e.condition != (None if own == first else own))
    twin = identified if own == first else current
    return replace(twin, effects=others, starts={**starts, **identified.starts})


def refined_twin(twin: TracksTwin, result: RefineResult) -> TracksTwin:
    """``twin``, see ``starting_twin``, with what ``result`` accepted; ``twin`` itself if that is nothing."""
    if not result.changes_twin:
        return twin
    after, forward_model = result.after, result.forward_model
    fit = {**twin.fit, "refined": errors_mm(after)}
    starts = {**twin.starts, **starts_of(after)}
    if not isinstance(forward_model, BodySimulation):
        effects = tuple(found_effect(term, after, None) for term in result.accepted)
        return replace(twin, effects=effects, starts=starts, fit=fit)
    everywhere = result.condition == conditions(forward_model.tracks)[0]
    scope = None if everywhere else result.condition
    kept = tuple(e for e in twin.effects if e.condition != scope)
    added = tuple(found_effect(t, after, scope, result.places.get(t.name)) for t in result.accepted)
    law = law_parameters(after, twin.law_values()) if everywhere else twin.parameters
    return replace(twin, parameters=law, effects=(*kept, *added), starts=starts, fit=fit)
