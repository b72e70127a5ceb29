"""What identify, refine and evaluate do with a scene of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from masiv import runtime
from masiv.config import Config
from masiv.errors import InputError, MasivError
from masiv.identify.tracks import conditions, family_of, fit_law, only_body, ratio_of, runs_of, simulation_of
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, ordered, rms_mm
from masiv.models.clamped_body import BodyRun, BodySimulation
from masiv.models.families import FAMILIES
from masiv.models.free_body import Model
from masiv.models.point_mass import RIGID, PointRun, PointSimulation, point_runs
from masiv.progress import Progress, silent
from masiv.refine.pooling import GroupRefined, baseline, refine_group
from masiv.refine.search import SearchResult, search_effects
from masiv.tracks.tracks import Tracks
from masiv.tracks.twin import RIGID_KIND, TracksTwin, found_effect, law_parameters, starts_of

AUTO = ("neo_hookean", "von_mises")
"""Laws that compete where none is named."""


@dataclass(frozen=True)
class Refined:
    """Of one body: as ``GroupRefined``; condition: of the runs."""

    result: SearchResult
    simulation: BodySimulation
    before: list[np.ndarray]
    after: list[np.ndarray]
    condition: str
    refused: dict[str, list[str]] = field(default_factory=dict)
    shared: tuple = ()


@dataclass(frozen=True)
class TwinSimulation:
    """A twin's simulation of runs: their model with its values."""

    simulation: BodySimulation | PointSimulation
    model: Model
    values: dict[str, float]

    def fields(self) -> list[np.ndarray]:
        """Simulated less observed of all runs, over all of their instants."""
        return self.simulation.fields(self.model, self.values, held_out=True)


def group_of(tracks: Tracks) -> str | None:
    """The group in which the bodies of a scene fly; None where it is of one body. Raises InputError for several."""
    if len(tracks.bodies) == 1 and next(iter(tracks.bodies.values())).clamp is not None:
        return None
    groups = tracks.groups()
    if len(groups) == 1 and all(len(run.markers) == 1 for run in tracks.runs):
        return next(iter(groups))
    only_body(tracks)
    return None


def identify_tracks(
    tracks: Tracks, config: Config, *, folder: Path | None = None, progress: Progress = silent
) -> tuple[TracksTwin, list[ModelFit]]:
    """The law that explains the runs of the first condition best, and the fits that competed, best first.

    Bodies that fly free are rigid: there is nothing to fit but their starts. Raises InputError for a law that has no
    few parameters, MasivError where none explains the motion. folder: keeps rollouts, so that a killed run goes on.
    """
    group = group_of(tracks)
    with runtime.torch_threads(1):
        if group is not None:
            simulation = PointSimulation(tracks, point_runs(tracks, group))
            fitted = baseline(simulation)
            twin = TracksTwin(RIGID_KIND, {}, group, starts=starts_of(fitted), fit=_errors(fitted))
            return twin, [fitted]
        kinds = _kinds(config.identify.law)
        body = only_body(tracks)
        known = ratio_of(body, config.tracks)
        condition = conditions(tracks)[0]
        fits: list[ModelFit] = []
        failed = ""
        for kind in kinds:
            mine = known if "poissons_ratio" in {p.name for p in FAMILIES[kind].parameters} else {}
            simulation = simulation_of(tracks, condition, config.tracks, config.simulator, known=mine, folder=folder)
            family = family_of(kind, body.density or 1e3, mine)
            try:
                fits.append(fit_law(simulation, family, config.tracks, progress))
            except MasivError as error:
                failed = str(error)
                progress(f"identify: {kind}", 1, 1, failed)
        if not fits:
            raise MasivError(f"identify: no classical law explains the motion: {failed}")
        fits = ordered(fits)
        best = fits[0]
        mine = known if "poissons_ratio" in law_names(best.model.family.kind) else {}
        twin = TracksTwin(
            best.model.family.kind, law_parameters(best, mine), None, starts=starts_of(best), fit=_errors(best)
        )
        return twin, fits


def law_names(kind: str) -> set[str]:
    """Names of a family's parameters."""
    return {p.name for p in FAMILIES[kind].parameters}


def _kinds(law: str) -> tuple[str, ...]:
    if law in ("neural", "adapter"):
        raise InputError(
            f"--law {law} needs a motion of the whole body, and a few markers do not show it: use --law auto, or one "
            f"of {', '.join(FAMILIES)}"
        )
    return AUTO if law == "auto" else (law,)


def _errors(fitted: ModelFit) -> dict[str, float | None]:
    return {"fit_rmse_mm": fitted.fit_mm, "held_out_rmse_mm": fitted.held_out_mm}


def simulated(tracks: Tracks, twin: TracksTwin, config: Config, condition: str | None = None) -> TwinSimulation:
    """``twin`` over the runs of ``condition`` (None: the first)."""
    if twin.group is not None:
        points = PointSimulation(tracks, point_runs(tracks, twin.group))
        terms = [(e, points.made(e.effect, e.bodies)) for e in twin.effects]
        model = Model(RIGID, "none", tuple(term.name for _, term in terms))
        values = {f"{term.name}.{n}": v for e, term in terms for n, (v, _, _) in e.parameters.items()}
        return TwinSimulation(points, model, {**twin.starts, **values})
    condition = conditions(tracks)[0] if condition is None else condition
    law = twin.law_values()
    simulation = simulation_of(tracks, condition, config.tracks, config.simulator, known=law)
    acting = twin.of(condition)
    model = Model(
        family_of(twin.law, only_body(tracks).density or 1e3, law),
        "sticky" if simulation.ground else "none",
        tuple(e.effect for e in acting),
    )
    values = {f"{e.effect}.{n}": v for e in acting for n, (v, _, _) in e.parameters.items()}
    return TwinSimulation(simulation, model, {**twin.starts, **values})


def refine_tracks(
    tracks: Tracks, twin: TracksTwin, config: Config, *, condition: str | None = None, dry_run: bool = False,
    folder: Path | None = None,
    progress: Progress = silent,
) -> Refined | GroupRefined:  # fmt: skip
    """What do the runs of ``condition`` lack? In the first condition the law is fitted with the effects; in others it
    and the effects already known are as the twin says. Raises InputError where no run is held out."""
    with runtime.torch_threads(1):
        if twin.group is not None:
            if condition is not None:
                raise InputError("--condition is for runs of one body: bodies in flight are refined together")
            return refine_group(tracks, twin.group, config.refine, dry_run=dry_run, progress=progress)
        first = conditions(tracks)[0]
        condition = first if condition is None else condition
        if not any(run.purpose == "hold_out" for run in runs_of(tracks, condition)):
            raise InputError(f"{tracks.path}: no run to judge by: give one of its runs `use: hold_out`")
        law = twin.law_values()
        values = {**law, **twin.starts}
        effects: tuple[str, ...] = ()
        if condition == first:
            known = {n: v for n, v in law.items() if twin.parameters[n][2] is None}
        else:
            acting = [e for e in twin.of(condition) if e.condition is None]
            effects = tuple(e.effect for e in acting)
            known = {**law, **{f"{e.effect}.{n}": v for e in acting for n, (v, _, _) in e.parameters.items()}}
        simulation = simulation_of(tracks, condition, config.tracks, config.simulator, known=known, folder=folder)
        family = family_of(twin.law, only_body(tracks).density or 1e3, known)
        model = Model(family, "sticky" if simulation.ground else "none", effects)
        progress("refine: without effects", 0, 1)
        base = gauss_newton_fit(simulation, model, values, budget=config.tracks.rollouts)
        progress("refine: without effects", 1, 1, f"{base.fit_mm:.2f} mm")
        # No stop-gap for what is left: a smooth force would need as many rollouts as all causes together.
        searched = config.refine.model_copy(update={"unexplained": np.inf, "search_second_effect": False})
        if dry_run:
            searched = searched.model_copy(update={"shortlist": 0, "above_noise": 0.0})
        result = search_effects(simulation, [base], searched, progress)
        before, after = (simulation.fields(f.model, f.values, held_out=True) for f in (result.before, result.after))
        return Refined(result, simulation, before, after, condition)


def twin_after(twin: TracksTwin, found: Refined | GroupRefined) -> TracksTwin:
    """``twin`` with what ``found`` accepted."""
    after, simulation = found.result.after, found.simulation
    terms = [simulation.term(n) for n in after.model.effects]
    fit = {**twin.fit, "refined": _errors(after)}
    if isinstance(found, GroupRefined):
        effects = tuple(found_effect(t, after, None) for t in terms)
        return replace(twin, effects=effects, starts={**twin.starts, **starts_of(after)}, fit=fit)
    assert isinstance(simulation, BodySimulation)
    new = tuple(t for t in terms if not all(p.name in simulation.known for p in t.parameters))
    everywhere = found.condition == conditions(simulation.tracks)[0]
    scope = None if everywhere else found.condition
    kept = tuple(e for e in twin.effects if e.condition != scope and not (everywhere and e.condition is None))
    effects = tuple(found_effect(t, after, scope, place_of(simulation, t.name, after)) for t in new)
    law = law_parameters(after, {n: v for n, v in twin.law_values().items()}) if everywhere else twin.parameters
    return replace(twin, parameters=law, effects=(*kept, *effects), starts={**twin.starts, **starts_of(after)}, fit=fit)


def place_of(simulation: BodySimulation, name: str, fitted: ModelFit) -> tuple[float, float, float] | None:
    """Where an effect sits, in the body's own axes [m]; None where it has no place."""
    values = [fitted.values.get(f"{name}.{axis}") for axis in "xyz"]
    run = simulation.observations[0]
    placement = next(r for r in simulation.tracks.runs if r.name == run.name).placement
    if placement is None or any(v is None for v in values):
        return None
    own = placement.to_own(run.body.frame.points_to_world(np.array(values, dtype=float)))
    return float(own[0]), float(own[1]), float(own[2])


def run_errors(runs: Sequence[BodyRun | PointRun], fields: Sequence[np.ndarray]) -> list[dict]:
    """Root mean square distance of each run [mm]."""
    return [
        {"run": run.name, "use": "fit" if run.fitted else "hold_out", "rmse_mm": rms_mm([f]), "instants": len(f)}
        for run, f in zip(runs, fields, strict=True)
    ]
