"""How well a model does if it knows the true law and the true effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def oracle(simulation, result, *, law: str, contact: str, parameters: Mapping[str, float], effects: Mapping) -> dict:
    """{fit_mm, validation_mm, values} of ``fit_true_model`` from the initial states of refine's model without effects
    and of its last one; {problem} if both diverge."""
    from masiv.errors import MasivError

    starts = [result.before] if result.after is result.before else [result.before, result.after]
    try:
        # Its own substeps: those that the search settled on may be too long for the true stiffness.
        best = fit_true_model(type(simulation)(simulation.setups), starts, law, contact, parameters, effects)
    except MasivError as failed:
        return {"problem": str(failed)}
    found = {n: v for n, v in best.values.items() if "@" not in n}
    return {"fit_mm": best.fit_mm, "validation_mm": best.validation_mm, "values": found}


def fit_true_model(
    simulation, starts: Sequence, law: str, contact: str, parameters: Mapping[str, float], effects: Mapping
):
    """The true law with the true effects, fitted from their true values and the initial states of ``starts``: the best
    of these fits. Raises MasivError if all diverge.

    parameters: of the law, effects: {effect: {parameter: value}}.
    """
    from masiv.errors import MasivError
    from masiv.inference.model_fit import gauss_newton_fit
    from masiv.models.base import Model, effect_parameters
    from masiv.models.families import FAMILIES

    model = Model(FAMILIES[law], contact, tuple(effects))
    true = {p.name: effects[n][p.name.split(".")[1]] for n in effects for p in effect_parameters(n)}
    fits, problem = [], None
    for start in starts:
        initial_states = {n: v for n, v in start.values.items() if "@" in n}
        try:
            fits.append(gauss_newton_fit(simulation, model, {**initial_states, **parameters, **true}, budget=24))
        except MasivError as failed:
            problem = failed
    if problem is not None and not fits:
        raise problem
    return min(fits, key=lambda f: f.fit_mm)
