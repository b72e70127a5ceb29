"""A twin of tracks over the runs of its scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.config import Config
from masiv.identify.tracks import conditions, family_of, only_body, simulation_of
from masiv.inference.model_fit import rms_mm
from masiv.models.clamped_body import BodyRun, BodySimulation
from masiv.models.free_body import Model
from masiv.models.point_mass import RIGID, PointRun, PointSimulation, point_runs
from masiv.tracks.tracks import Tracks
from masiv.tracks.twin import TracksTwin


@dataclass(frozen=True)
class TwinSimulation:
    """A twin's forward model of runs: their model with its values."""

    simulation: BodySimulation | PointSimulation
    model: Model
    values: dict[str, float]

    def fields(self) -> list[np.ndarray]:
        """Simulated less observed of all runs, over all of their instants."""
        return self.simulation.fields(self.model, self.values, held_out=True)


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


def run_errors(runs: Sequence[BodyRun | PointRun], fields: Sequence[np.ndarray]) -> list[dict]:
    """Root mean square distance of each run [mm]."""
    return [
        {"run": run.name, "use": "fit" if run.fitted else "hold_out", "rmse_mm": rms_mm([f]), "instants": len(f)}
        for run, f in zip(runs, fields, strict=True)
    ]
