"""A twin of tracks in situations that were not measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from masiv.config import Config
from masiv.errors import InputError
from masiv.files import write_npz
from masiv.models.clamped_body import BodySimulation
from masiv.models.point_mass import PointRun, PointSimulation
from masiv.mpm.rollout import rollout
from masiv.refine.tracks_stage import simulated
from masiv.tracks.tracks import Tracks
from masiv.tracks.twin import TracksTwin


@torch.no_grad()
def simulate_tracks(
    tracks: Tracks,
    twin: TracksTwin,
    config: Config,
    *,
    frames: int,
    gravity: np.ndarray | None = None,
    without: tuple[str, ...] = (),
    condition: str | None = None,
) -> dict[str, np.ndarray]:
    """positions (T, Q, 3) float32 and markers (T, M, 3) [m, world] at times (T,) [s], ``frames`` at the rate of the
    first run, and names (M,). Of a group: one point a body, from its first fitted run's start.

    gravity (3,) [m/s², world] takes the place of the scene's; without: effects that are left out. Raises InputError for
    an effect that the twin does not have.
    """
    for name in without:
        if name not in {e.effect for e in twin.effects}:
            has = ", ".join(dict.fromkeys(e.effect for e in twin.effects)) or "none"
            raise InputError(f"--without {name}: the twin has no such effect, it has {has}")
    twin = replace(twin, effects=tuple(e for e in twin.effects if e.effect not in without))
    if gravity is not None:
        tracks = replace(tracks, gravity=np.asarray(gravity, dtype=np.float64))
    made = simulated(tracks, twin, config, condition)
    if isinstance(made.simulation, PointSimulation):
        return _flights(made.simulation, made.model, made.values, frames, tracks.runs[0].rate)
    return _swing(made.simulation, made.model, made.values, frames, tracks)


def _flights(simulation: PointSimulation, model, values, frames: int, rate: float) -> dict[str, np.ndarray]:
    times = np.arange(frames) / rate
    paths, names = [], []
    for body in simulation.bodies:
        run: PointRun = next(r for r in simulation.observations if r.body == body and r.fitted)
        whole = np.zeros((frames, 3))
        observed = np.zeros((frames, len(run.axes)))
        flight = simulation.flight(replace(run, times=times, observed=observed), model, values)
        whole[:, list(run.axes)] = flight
        paths.append(whole)
        names.append(body)
    markers = np.stack(paths, axis=1)
    return _result(markers, markers, times, names)


def _swing(simulation: BodySimulation, model, values, frames: int, tracks: Tracks) -> dict[str, np.ndarray]:
    run = next(r for r in simulation.observations if r.fitted)
    rate = next(r.rate for r in tracks.runs if r.name == run.name)
    times = np.arange(frames) / rate
    planned = simulation.planned(run, model, values, times)
    effects = simulation.acting(run, model, values, float(times[-1]))
    state = run.body.released(planned.simulator.dtype)
    outputs = sorted(set(planned.outputs))
    positions = rollout(planned.simulator, simulation.law(model, values), state, planned.steps, outputs, effects)
    rows = [outputs.index(step) for step in planned.outputs]
    positions = positions[rows]
    names = [next(r for r in tracks.runs if r.name == run.name).markers[m] for m in run.body.markers]
    world = run.body.frame.points_to_world(positions.double().numpy())
    return _result(world, run.body.markers_to_world(positions), times, names)


def _result(positions: np.ndarray, markers: np.ndarray, times: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    return {
        "positions": positions.astype(np.float32),
        "times": times,
        "markers": markers,
        "marker_names": np.array(names),
    }


def save_rollout(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    """rollout.npz, complete or not at all."""
    write_npz(folder / "rollout.npz", **arrays)
    return folder / "rollout.npz"
