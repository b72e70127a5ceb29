"""The law of a body with markers, from how it moves when it is let go."""

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
from masiv.tracks.tracks import Body, Run, Tracks

STIFFNESSES = 13
"""Values of the law's modulus that the first search tries, between the bounds of its family."""


def only_body(tracks: Tracks) -> Body:
    """The body of a scene that has one. Raises InputError."""
    if len(tracks.bodies) != 1:
        raise InputError(
            f"{tracks.path} has {len(tracks.bodies)} bodies: bodies that fly free are refined with --group, of others "
            "there is one a scene"
        )
    return next(iter(tracks.bodies.values()))


def conditions(tracks: Tracks) -> tuple[str, ...]:
    """In the order of the scene; the first is that in which the law is found."""
    return tuple(dict.fromkeys(run.condition for run in tracks.runs))


def runs_of(tracks: Tracks, condition: str) -> tuple[Run, ...]:
    """The runs of a condition. Raises InputError where it has none to fit."""
    found = tuple(run for run in tracks.runs if run.condition == condition)
    if not any(run.purpose == "fit" for run in found):
        known = ", ".join(repr(c) for c in conditions(tracks))
        raise InputError(f"{tracks.path} has no run of condition '{condition}' to fit: its conditions are {known}")
    return found


def simulation_of(
    tracks: Tracks, condition: str, config: TracksConfig, simulator: SimulatorConfig, *, known: dict[str, float],
    folder: Path | None = None, whole: bool = False,
) -> ClampedBodyModel:  # fmt: skip
    """The runs of ``condition`` over the configured time; ``whole``: with the first moments that they leave out."""
    body = only_body(tracks)
    if body.geometry is None:
        raise InputError(f"{tracks.path}: body {body.name} needs a geometry, and a density or a mass, to be simulated")

    spacing = (body.geometry.volume / config.particles) ** (1 / 3)
    runs = [
        run_of_body(tracks, run, simulator, spacing, config.duration, 0.0 if whole else run.ignore_after_release)
        for run in runs_of(tracks, condition)
    ]
    last = max(float(observation.times[-1]) for observation, _ in runs)
    horizons = [h for k in range(16) if (h := config.search_duration * 2**k) < 0.9 * last]
    return ClampedBodyModel(tracks, runs, known=known, horizons=horizons, folder=folder)


def ratio_of(body: Body, config: TracksConfig) -> dict[str, float]:
    """Poisson's ratio, where the scene declares it: no more than what is affordable."""
    if body.poissons_ratio is None:
        return {}
    return {"poissons_ratio": min(body.poissons_ratio, config.max_poissons_ratio)}


def fit_law(simulation: ClampedBodyModel, family: Family, config: TracksConfig, progress: Progress) -> ModelFit:
    """``family`` fitted to the fitted runs: its scale by a search over the first moments, then all its parameters
    over ever more of the motion. Where the first moments are to be left out, that is done with them first: they have
    the phase from which the rest is counted. Raises MasivError where every law diverges."""
    model = Model(family, simulation.contact)
    if any(run.skipped for run in simulation.observations):
        whole = simulation_of(
            simulation.tracks, simulation.observations[0].condition, config, simulation.config,
            known=simulation.known, folder=simulation.folder, whole=True,
        )  # fmt: skip
        return gauss_newton_fit(
            simulation, model, fit_law(whole, family, config, progress).values, budget=config.rollouts
        )
    horizon, last = config.search_duration, max(float(run.times[-1]) for run in simulation.observations)
    values = _searched(_cut(simulation, horizon), model, progress)
    while True:
        horizon = min(2 * horizon, last)
        label = f"identify: {family.kind}"
        progress(label, round(1e3 * horizon / 2), round(1e3 * last), "")
        here = simulation if horizon == last else _cut(simulation, horizon)
        fitted = gauss_newton_fit(here, model, values, budget=config.rollouts)
        values = fitted.values
        progress(label, round(1e3 * horizon), round(1e3 * last), f"{fitted.fit_mm:.2f} mm over {horizon:.2g} s")
        if horizon == last:
            return fitted


def _cut(simulation: ClampedBodyModel, duration: float) -> ClampedBodyModel:
    runs = [run.shortened(duration) for run in simulation.observations if run.fitted]
    return simulation.over(runs)


def _searched(simulation: ClampedBodyModel, model: Model, progress: Progress) -> dict[str, float]:
    """Start values, the modulus by which the family searches first the best of a few."""
    start = {p.name: p.start for p in simulation.parameters(model)}
    scale: Parameter = next(p for p in model.family.parameters if p.log)
    found = []
    label = f"identify: {model.family.kind} search"
    for k, value in enumerate(np.geomspace(3 * scale.lower, scale.upper / 3, STIFFNESSES)):
        simulation.held.clear()
        try:
            error = rms_mm(simulation.fields(model, {**start, scale.name: float(value)}))
            found.append((error, float(value)))
            note = f"{value:.2g}: {error:.2f} mm"
        except (NonFiniteError, MasivError) as failed:
            note = str(failed)[:40]
        progress(label, k + 1, STIFFNESSES, note)
    if not found:
        raise MasivError(f"identify: every {model.family.kind} law diverges: check density, units and geometry")
    return {**start, scale.name: min(found)[1]}
