"""The law of a clamped body from the motion of its markers after the release.

The coarse search over the modulus compares the first moments alone; then Gauss-Newton fits all parameters over a
growing horizon, since over a longer one a wrong frequency is out of phase.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.inference.model_fit import ModelFit, gauss_newton_fit
from masiv.models.base import Model
from masiv.models.clamped_body import ClampedBodyModel, run_of_body
from masiv.models.families import Family
from masiv.models.parameters import Parameter
from masiv.mpm.config import SimulatorConfig
from masiv.observations.base import rms_mm
from masiv.progress import Progress
from masiv.tracks.config import TracksConfig
from masiv.tracks.tracks import Run, TrackedBody, Tracks

SEARCHED_MODULI = 13
"""Number of values of the law's modulus that the search tries, between the bounds of its family."""


def single_body(tracks: Tracks) -> TrackedBody:
    """The body of a scene with one body. Raises InputError for several."""
    if len(tracks.bodies) != 1:
        raise InputError(
            f"{tracks.path} has {len(tracks.bodies)} bodies: refine bodies in free flight with --group; a scene has "
            "only one body of another kind"
        )
    return next(iter(tracks.bodies.values()))


def conditions(tracks: Tracks) -> tuple[str, ...]:
    """Names of the conditions in the order of the scene; the law is identified in the first."""
    return tuple(dict.fromkeys(run.condition for run in tracks.runs))


def runs_in_condition(tracks: Tracks, condition: str) -> tuple[Run, ...]:
    """The runs of a condition. Raises InputError if it has no run to fit."""
    found = tuple(run for run in tracks.runs if run.condition == condition)
    if not any(run.purpose == "fit" for run in found):
        known = ", ".join(repr(c) for c in conditions(tracks))
        raise InputError(f"{tracks.path} has no run of condition '{condition}' to fit: its conditions are {known}")
    return found


def clamped_body_model(
    tracks: Tracks, condition: str, config: TracksConfig, simulator: SimulatorConfig, *, known: dict[str, float],
    folder: Path | None = None, whole: bool = False,
) -> ClampedBodyModel:  # fmt: skip
    """The forward model of the runs of ``condition`` over the configured duration.

    known: values of parameters that are not fitted. folder: keeps rollouts. whole: with the first moments of each run,
    which the scene asks to ignore. Raises InputError for a body without a geometry.
    """
    body = single_body(tracks)
    if body.geometry is None:
        raise InputError(f"{tracks.path}: body {body.name} needs a geometry, and a density or a mass, to be simulated")

    spacing = (body.geometry.volume / config.particles) ** (1 / 3)
    runs = [
        run_of_body(tracks, run, simulator, spacing, config.duration, 0.0 if whole else run.ignore_after_release)
        for run in runs_in_condition(tracks, condition)
    ]
    last = max(float(observation.times[-1]) for observation, _ in runs)
    horizons = [h for k in range(16) if (h := config.search_duration * 2**k) < 0.9 * last]
    return ClampedBodyModel(tracks, runs, known=known, horizons=horizons, folder=folder)


def declared_poissons_ratio(body: TrackedBody, config: TracksConfig) -> dict[str, float]:
    """Poisson's ratio if the scene declares it; at most ``config.max_poissons_ratio``, to limit the substeps."""
    if body.poissons_ratio is None:
        return {}
    return {"poissons_ratio": min(body.poissons_ratio, config.max_poissons_ratio)}


def fit_law(simulation: ClampedBodyModel, family: Family, config: TracksConfig, progress: Progress) -> ModelFit:
    """``family`` fitted to the runs to fit.

    A search over the first moments finds the modulus; then all parameters are fitted over a horizon that doubles. If
    the scene asks to ignore the first moments of a run, the law is first fitted with them: without them the phase of an
    oscillation is unknown. Raises MasivError if every law diverges.
    """
    model = Model(family, simulation.contact)
    if any(run.skipped for run in simulation.observations):
        whole = clamped_body_model(
            simulation.tracks, simulation.observations[0].condition, config, simulation.config,
            known=simulation.known, folder=simulation.folder, whole=True,
        )  # fmt: skip
        return gauss_newton_fit(
            simulation, model, fit_law(whole, family, config, progress).values, budget=config.rollouts
        )
    horizon, last = config.search_duration, max(float(run.times[-1]) for run in simulation.observations)
    values = _search_modulus(_shortened(simulation, horizon), model, progress)
    while True:
        horizon = min(2 * horizon, last)
        label = f"identify: {family.kind}"
        progress(label, round(1e3 * horizon / 2), round(1e3 * last), "")
        here = simulation if horizon == last else _shortened(simulation, horizon)
        fitted = gauss_newton_fit(here, model, values, budget=config.rollouts)
        values = fitted.values
        progress(label, round(1e3 * horizon), round(1e3 * last), f"{fitted.fit_mm:.2f} mm over {horizon:.2g} s")
        if horizon == last:
            return fitted


def _shortened(simulation: ClampedBodyModel, duration: float) -> ClampedBodyModel:
    """The runs to fit over their first ``duration`` [s]."""
    runs = [run.shortened(duration) for run in simulation.observations if run.fitted]
    return simulation.over(runs)


def _search_modulus(simulation: ClampedBodyModel, model: Model, progress: Progress) -> dict[str, float]:
    """The start values, with the best of ``SEARCHED_MODULI`` moduli. Raises MasivError if all diverge."""
    start = {p.name: p.start for p in simulation.parameters(model)}
    scale: Parameter = next(p for p in model.family.parameters if p.log)
    found = []
    label = f"identify: {model.family.kind} search"
    for k, value in enumerate(np.geomspace(3 * scale.lower, scale.upper / 3, SEARCHED_MODULI)):
        simulation.held.clear()
        try:
            error = rms_mm(simulation.fields(model, {**start, scale.name: float(value)}))
            found.append((error, float(value)))
            note = f"{value:.2g}: {error:.2f} mm"
        except (NonFiniteError, MasivError) as failed:
            note = str(failed)[:40]
        progress(label, k + 1, SEARCHED_MODULI, note)
    if not found:
        raise MasivError(f"identify: every {model.family.kind} law diverges: check density, units and geometry")
    return {**start, scale.name: min(found)[1]}
