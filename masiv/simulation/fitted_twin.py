"""From a fit to a twin, and from a twin to the values of a model."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.materials.classical import PARAMETERS, ClassicalLaw
from masiv.models.base import EffectTerm, ForwardModel
from masiv.models.clamped_body import ClampedBodyModel
from masiv.models.free_body import FreeBodyModel
from masiv.scene.scene import Ground
from masiv.twin import Boundary, InitialCondition, Twin, TwinEffect
from masiv.twin.body import with_start_values


def fitted_twin(old: Twin, fitted: ModelFit, forward: ForwardModel, fit: dict[str, Any]) -> Twin:
    """``old`` with the law, the boundary, the starts and the effects of ``fitted``, a fit of ``forward``. fit: what to
    say of it.

    The fit belongs to the condition of its first observation. In the first condition of the twin, effects act
    everywhere and the law is the fitted one; in another, effects act there alone. Effects of other scopes stay, and so
    does what was known in the fit.
    """
    names = [observation.name for observation in forward.observations]
    condition = next((s.condition for s in old.initial_conditions if s.observation in names), old.conditions[0])
    scope = None if condition == old.conditions[0] else condition
    known: dict[str, float] = getattr(forward, "known", {})
    terms = [forward.term(name) for name in fitted.model.effects]
    new = [term for term in terms if not all(p.name in known for p in term.parameters)]
    kept = [effect for effect in old.effects if effect.condition != scope]
    effects = (*kept, *(_effect(term, fitted, scope, place_of(forward, term.name, fitted)) for term in new))
    if fitted.model.family.parameters:
        law = _law(old, fitted, known)
        old = replace(old, bodies=tuple(replace(body, law=law) for body in old.bodies))
    starts, boundary = _starts(old, fitted, forward)
    return replace(old, initial_conditions=starts, boundary=boundary, effects=effects, fit=fit)


def _law(old: Twin, fitted: ModelFit, known: dict[str, float]) -> ClassicalLaw:
    """The fitted law; of parameters that were not fitted, the values that were known, without a standard error."""
    kind, before = fitted.model.family.kind, old.bodies[0].law
    values = law_values(old) if isinstance(before, ClassicalLaw) and before.kind == kind else {}
    values = {**values, **known, **fitted.values}
    law = ClassicalLaw(kind, **{name: values[name] for name in PARAMETERS[kind]})
    law.stderr = {p.name: e for p in fitted.model.family.parameters if (e := _finite(fitted, p.name)) is not None}
    return law


def _finite(fitted: ModelFit, name: str) -> float | None:
    """The standard error of a value; None if the data does not determine it."""
    error = fitted.stderr.get(name, math.inf)
    return error if math.isfinite(error) else None


def _effect(
    term: EffectTerm, fitted: ModelFit, condition: str | None, place: tuple[float, float, float] | None
) -> TwinEffect:
    short = {p.name: p.name.removeprefix(f"{term.name}.") for p in term.parameters}
    return TwinEffect(
        term.effect,
        {name: fitted.values[full] for full, name in short.items()},
        {name: _finite(fitted, full) for full, name in short.items()},
        term.bodies,
        condition,
        place,
    )


def place_of(forward: ForwardModel, name: str, fitted: ModelFit) -> tuple[float, float, float] | None:
    """The place of an effect in the body's own axes [m]; None if it has none, or if those axes are not known."""
    values = [fitted.values.get(f"{name}.{axis}") for axis in "xyz"]
    if not isinstance(forward, ClampedBodyModel) or any(value is None for value in values):
        return None
    first = forward.observations[0]
    placement = next(run for run in forward.tracks.runs if run.name == first.name).placement
    if placement is None:
        return None
    x, y, z = placement.to_own(forward.body(first).axes.points_to_world(np.array(values, dtype=float)))
    return float(x), float(y), float(z)


def _starts(old: Twin, fitted: ModelFit, forward: ForwardModel) -> tuple[tuple[InitialCondition, ...], Boundary]:
    if not isinstance(forward, FreeBodyModel):
        return tuple(with_start_values(start, fitted.values) for start in old.initial_conditions), old.boundary
    body = old.body
    starts = []
    for index, (observation, setup) in enumerate(zip(forward.observations, forward.setups, strict=True)):
        state, axes = forward.initial_state(fitted.values, index), setup.body.axes
        starts.append(
            InitialCondition(
                observation.name,
                body.name,
                setup.body.scene.fps,
                axes.vectors_to_world(state.velocity.double().numpy()),
                axes.vectors_to_world(state.omega.double().numpy()),
            )
        )
    ground: Ground | None = forward.initial_state(fitted.values, 0).ground(forward.setups[0].body.scene.ground)
    return tuple(starts), replace(old.boundary, ground=ground, contact=fitted.model.contact)


def law_values(twin: Twin) -> dict[str, float]:
    """Parameters of the law of the only body; none if it is rigid."""
    law = twin.body.law if not twin.rigid else None
    return {name: float(value.detach()) for name, value in law.values.items()} if isinstance(law, ClassicalLaw) else {}


def start_values(twin: Twin) -> dict[str, float]:
    """What was fitted of the starts, named ``what@observation`` as the parameters of point masses and of bodies with
    markers are."""
    values: dict[str, float] = {}
    for start in twin.initial_conditions:
        own: dict[str, float] = {}
        if start.release is not None:
            own = dict(start.release.offsets)
        elif start.placement is not None:
            own = {f"position_{a}": float(start.placement.translation[k]) for k, a in enumerate("xyz")}
            own |= {f"velocity_{a}": float(start.velocity[k]) for k, a in enumerate("xyz")}
        values |= {f"{name}@{start.observation}": value for name, value in own.items()}
    return values


def effect_values(effect: TwinEffect, term: str) -> dict[str, float]:
    """Values of an effect, named as the parameters of the ``term``."""
    return {f"{term}.{name}": value for name, value in effect.values.items()}
