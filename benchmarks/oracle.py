"""How well a model does that was told which effects are missing."""

from __future__ import annotations

from collections.abc import Mapping


def oracle(simulation, outcome, *, law: str, contact: str, parameters: Mapping[str, float], effects: Mapping) -> dict:
    """Fit the true law with the true effects, which begin at their true values: {fit_mm, held_out_mm, values}, the
    better of the fits whose throw begins at that of refine's model without effects, and of its last; {problem} where
    both diverge.

    parameters: of the law, effects: {effect: {parameter: value}}.
    """
    from masiv.errors import MasivError
    from masiv.identify.families import FAMILIES
    from masiv.refine.model import Model, effect_parameters
    from masiv.refine.refit import full_fit

    # Its own substeps: those that the search settled on may be too long for the true stiffness.
    simulation = type(simulation)(simulation.experiments)
    model = Model(FAMILIES[law], contact, tuple(effects))
    told = {p.name: effects[n][p.name.split(".")[1]] for n in effects for p in effect_parameters(n)}
    fits, problem = [], ""
    starts = [outcome.before] if outcome.after is outcome.before else [outcome.before, outcome.after]
    for start in starts:
        throw = {n: v for n, v in start.values.items() if "@" in n}
        try:
            fits.append(full_fit(simulation, model, {**throw, **parameters, **told}, budget=24))
        except MasivError as failed:
            problem = str(failed)
    if not fits:
        return {"problem": problem}
    best = min(fits, key=lambda f: f.fit_mm)
    found = {n: v for n, v in best.values.items() if "@" not in n}
    return {"fit_mm": best.fit_mm, "held_out_mm": best.held_out_mm, "values": found}
