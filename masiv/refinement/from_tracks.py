"""Refine runs of a scene of tracks: of one clamped body, or of several bodies that fly free and share physics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from masiv import runtime
from masiv.errors import InputError
from masiv.identification.from_tracks import flight_group
from masiv.identification.tracks import clamped_body_model, conditions, runs_in_condition, single_body
from masiv.inference.model_fit import gauss_newton_fit
from masiv.materials.classical import ClassicalLaw
from masiv.models.base import Model
from masiv.models.families import family_of
from masiv.models.point_mass import PointMassModel
from masiv.mpm.config import SimulatorConfig
from masiv.observations.tracks import flight_observations
from masiv.progress import Progress, silent
from masiv.refinement.config import RefineConfig
from masiv.refinement.pooling import refine_bodies
from masiv.refinement.result import RefineResult
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import check_effects, refine
from masiv.simulation.fitted_twin import effect_values, law_values, place_of, start_values
from masiv.tracks.config import TracksConfig
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin

NOT_FOR_TRACKS = {
    "particles": "tracks.particles",
    "search_particles": "tracks.particles",
    "samples_per_frame": "every measured instant",
    "families": "the law of identify",
    "laws": "identify.law",
    "baseline_rollouts": "tracks.rollouts",
    "test_fraction": "the runs with `use: test`",
    "camera_split": "the noise of the markers at rest",
    "tracking_error": "the noise of the markers at rest",
}
"""Keys of refine that say nothing of tracks, and what holds for these."""


def refine_tracks(
    tracks: Tracks, twin: Twin, refine_config: RefineConfig, config: TracksConfig, simulator: SimulatorConfig, *,
    condition: str | None = None, dry_run: bool = False, folder: Path | None = None, progress: Progress = silent,
) -> RefineResult:  # fmt: skip
    """Which effects does the model of the runs lack? Runs with ``use: hold_out`` judge them; errors of runs
    with ``use: test`` are reported.

    Of one body, the runs of ``condition`` (None: the first): in the first condition the law is fitted with the effects;
    in others it and the effects already known are as ``twin`` says. ``twin``: as identify made it, with the effects of
    other conditions. folder: keeps rollouts, so that a killed run goes on. dry_run: rank the effects, fit none.
    Raises InputError if no run is held out, and for a key of refine that says nothing of tracks.
    """
    check_effects(refine_config)
    check_config(refine_config)
    settings = SearchSettings.of(refine_config, rank_only=dry_run, progress=progress)
    with runtime.torch_threads(1):
        group = flight_group(tracks)
        if group is None:
            return _refine_body(tracks, twin, config, simulator, settings, condition, folder)
        if condition is not None:
            raise InputError("--condition is for runs of one body: bodies in flight are refined together")
        return refine_group(tracks, group, settings)


def check_config(config: RefineConfig) -> None:
    """Raises InputError for a setting that says nothing of tracks and is not the default: it would be ignored."""
    default = RefineConfig.model_validate({})
    for key, instead in NOT_FOR_TRACKS.items():
        if getattr(config, key) != getattr(default, key):
            raise InputError(f"refine.{key} is for scenes of pictures: leave it out, tracks have {instead}")
    if config.processes > 1:
        raise InputError("refine.processes: tracks are simulated in one process: leave it out, or give 1")
    if config.scheduler:
        raise InputError("refine.scheduler: tracks are simulated in one process: leave it out")


def refine_group(tracks: Tracks, group: str, settings: SearchSettings) -> RefineResult:
    """The flights of the bodies of ``group``. Raises InputError if a body has no run to fit or none that is held
    out."""
    forward_model = PointMassModel(tracks, flight_observations(tracks, group))
    for body in forward_model.bodies:
        if not {"fit", "hold_out"} <= {run.purpose for run in forward_model.observations if run.body == body}:
            raise InputError(f"{tracks.path}: body {body} needs a run to fit and one with `use: hold_out` to judge by")
    return refine_bodies(forward_model, settings)


def _refine_body(
    tracks: Tracks, twin: Twin, config: TracksConfig, simulator: SimulatorConfig, settings: SearchSettings,
    condition: str | None, folder: Path | None,
) -> RefineResult:  # fmt: skip
    first = conditions(tracks)[0]
    condition = first if condition is None else condition
    if not any(run.purpose == "hold_out" for run in runs_in_condition(tracks, condition)):
        raise InputError(f"{tracks.path}: no run to judge by: give one of its runs `use: hold_out`")
    law = law_values(twin)
    effects: tuple[str, ...] = ()
    if condition == first:
        assert isinstance(twin.law, ClassicalLaw)
        known = {n: v for n, v in law.items() if n not in twin.law.stderr}
    else:
        acting = [e for e in twin.effects if e.condition is None]
        effects = tuple(e.name for e in acting)
        known = {**law, **{n: v for e in acting for n, v in effect_values(e, e.name).items()}}
    forward_model = clamped_body_model(tracks, condition, config, simulator, known=known, folder=folder)
    family = family_of(twin.law.kind, single_body(tracks).density or 1e3, known)
    model = Model(family, forward_model.contact, effects)
    settings.progress("refine: without effects", 0, 1)
    base = gauss_newton_fit(forward_model, model, {**law, **start_values(twin)}, budget=config.rollouts)
    settings.progress("refine: without effects", 1, 1, f"{base.fit_mm:.2f} mm")
    # A smooth force for the rest would need as many rollouts as all effects together.
    result = refine(forward_model, [base], replace(settings, discrepancy_force=False), condition=condition)
    places = {t.name: place_of(forward_model, t.name, result.after) for t in result.accepted}
    return replace(result, places={name: place for name, place in places.items() if place is not None})
