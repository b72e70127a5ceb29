"""A twin over the runs of a scene of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from masiv.identification.from_tracks import flight_group
from masiv.identification.tracks import clamped_body_model, single_body
from masiv.models.base import Model
from masiv.models.clamped_body import ClampedBodyModel
from masiv.models.families import family_of
from masiv.models.point_mass import RIGID, PointMassModel
from masiv.mpm.config import SimulatorConfig
from masiv.observations.base import rms_mm
from masiv.observations.tracks import TracksObservation, flight_observations
from masiv.simulation.fitted_twin import effect_values, law_values, start_values
from masiv.tracks.config import TracksConfig
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin


@dataclass(frozen=True)
class TwinSimulation:
    """A twin as a forward model of runs: the model of the runs, and the twin's values of its parameters."""

    simulation: ClampedBodyModel | PointMassModel
    model: Model
    values: dict[str, float]

    def fields(self) -> list[np.ndarray]:
        """Simulated less observed (T, N, A) [m] of all runs, over all of their instants."""
        return self.simulation.fields(self.model, self.values, held_out=True)


def simulate_runs(
    tracks: Tracks, twin: Twin, config: TracksConfig, simulator: SimulatorConfig, condition: str | None = None
) -> TwinSimulation:
    """``twin`` as a forward model of the runs of ``condition`` (None: the first)."""
    group = flight_group(tracks)
    if group is not None:
        points = PointMassModel(tracks, flight_observations(tracks, group))
        terms = [(e, points.scoped_term(e.name, e.bodies).name) for e in twin.effects]
        values = {n: v for e, term in terms for n, v in effect_values(e, term).items()}
        return TwinSimulation(
            points, Model(RIGID, "none", tuple(term for _, term in terms)), {**start_values(twin), **values}
        )
    twin = twin.in_condition(condition)
    law = law_values(twin)
    simulation = clamped_body_model(tracks, twin.conditions[0], config, simulator, known=law)
    model = Model(
        family_of(twin.law.kind, single_body(tracks).density or 1e3, law),
        simulation.contact,
        tuple(e.name for e in twin.effects),
    )
    values = {n: v for e in twin.effects for n, v in effect_values(e, e.name).items()}
    return TwinSimulation(simulation, model, {**start_values(twin), **values})


def run_errors(runs: Sequence[TracksObservation], fields: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    """Root mean square distance [mm] of each run, from its residuals (T, N, A) [m]."""
    return [
        {"run": run.name, "use": run.purpose, "rmse_mm": rms_mm([f]), "instants": len(f)}
        for run, f in zip(runs, fields, strict=True)
    ]
