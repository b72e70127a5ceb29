"""What identify, refine and evaluate do with a scene of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from masiv import runtime
from masiv.config import Config
from masiv.errors import InputError, MasivError
from masiv.identify.tracks import conditions, family_of, fit_law, only_body, ratio_of, runs_of, simulation_of
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, ordered, rms_mm
from masiv.materials.classical import ClassicalLaw
from masiv.models.clamped_body import BodyRun, BodySimulation
from masiv.models.families import FAMILIES
from masiv.models.free_body import Model
from masiv.models.point_mass import RIGID, PointRun, PointSimulation, point_runs
from masiv.progress import Progress, silent
from masiv.refine.pooling import GroupRefined, baseline, refine_group
from masiv.refine.search import SearchResult, search_effects
from masiv.simulation.fitted_twin import effect_values, fitted_twin, law_values, start_values
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin
from masiv.twin.from_tracks import twin_of_tracks

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
) -> tuple[Twin, list[ModelFit]]:
    """The law that explains the runs of the first condition best, and the fits that competed, best first.

    Bodies that fly free are rigid: there is nothing to fit but their starts. Raises InputError for a law that has no
    few parameters, MasivError where none explains the motion. folder: keeps rollouts, so that a killed run goes on.
    """
    group = group_of(tracks)
    with runtime.torch_threads(1):
        if group is not None:
            simulation = PointSimulation(tracks, point_runs(tracks, group))
            fitted = baseline(simulation)
            return fitted_twin(described_twin(tracks, config), fitted, simulation, _errors(fitted)), [fitted]
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
        simulation = simulation_of(
            tracks, condition, config.tracks, config.simulator, known=mine, folder=folder
        )  # fmt: skip
        return fitted_twin(described_twin(tracks, config), best, simulation, _errors(best)), fits


def described_twin(tracks: Tracks, config: Config) -> Twin:
    """What the scene says of its bodies and of how they start, without what is fitted. Raises InputError."""
    return twin_of_tracks(tracks, config.tracks, config.simulator, rigid=group_of(tracks) is not None)


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


def simulated(tracks: Tracks, twin: Twin, config: Config, condition: str | None = None) -> TwinSimulation:
    """``twin`` over the runs of ``condition`` (None: the first)."""
    group = group_of(tracks)
    if group is not None:
        points = PointSimulation(tracks, point_runs(tracks, group))
        terms = [(e, points.made(e.name, e.bodies).name) for e in twin.effects]
        values = {n: v for e, term in terms for n, v in effect_values(e, term).items()}
        return TwinSimulation(
            points, Model(RIGID, "none", tuple(term for _, term in terms)), {**start_values(twin), **values}
        )
    twin = twin.in_condition(condition)
    law = law_values(twin)
    simulation = simulation_of(tracks, twin.conditions[0], config.tracks, config.simulator, known=law)
    model = Model(
        family_of(twin.law.kind, only_body(tracks).density or 1e3, law),
        "sticky" if simulation.ground else "none",
        tuple(e.name for e in twin.effects),
    )
    values = {n: v for e in twin.effects for n, v in effect_values(e, e.name).items()}
    return TwinSimulation(simulation, model, {**start_values(twin), **values})


def refine_tracks(
    tracks: Tracks, twin: Twin, config: Config, *, condition: str | None = None, dry_run: bool = False,
    folder: Path | None = None,
    progress: Progress = silent,
) -> Refined | GroupRefined:  # fmt: skip
    """What do the runs of ``condition`` lack? In the first condition the law is fitted with the effects; in others it
    and the effects already known are as the twin says. Raises InputError where no run is held out."""
    with runtime.torch_threads(1):
        group = group_of(tracks)
        if group is not None:
            if condition is not None:
                raise InputError("--condition is for runs of one body: bodies in flight are refined together")
            return refine_group(tracks, group, config.refine, dry_run=dry_run, progress=progress)
        first = conditions(tracks)[0]
        condition = first if condition is None else condition
        if not any(run.purpose == "hold_out" for run in runs_of(tracks, condition)):
            raise InputError(f"{tracks.path}: no run to judge by: give one of its runs `use: hold_out`")
        law = law_values(twin)
        values = {**law, **start_values(twin)}
        effects: tuple[str, ...] = ()
        if condition == first:
            assert isinstance(twin.law, ClassicalLaw)
            known = {n: v for n, v in law.items() if n not in twin.law.stderr}
        else:
            acting = [e for e in twin.effects if e.condition is None]
            effects = tuple(e.name for e in acting)
            known = {**law, **{n: v for e in acting for n, v in effect_values(e, e.name).items()}}
        simulation = simulation_of(tracks, condition, config.tracks, config.simulator, known=known, folder=folder)
        family = family_of(twin.law.kind, only_body(tracks).density or 1e3, known)
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


def refined_twin(twin: Twin, found: Refined | GroupRefined) -> Twin:
    """``twin`` with what ``found`` accepted."""
    after = found.result.after
    return fitted_twin(twin, after, found.simulation, {**twin.fit, "refined": _errors(after)})


def run_errors(runs: Sequence[BodyRun | PointRun], fields: Sequence[np.ndarray]) -> list[dict]:
    """Root mean square distance of each run [mm]."""
    return [
        {"run": run.name, "use": "fit" if run.fitted else "hold_out", "rmse_mm": rms_mm([f]), "instants": len(f)}
        for run, f in zip(runs, fields, strict=True)
    ]
