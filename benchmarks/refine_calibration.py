"""Are the probabilities of refine right? Closed-form flights with jitter and smooth errors, with and without drag.

    python benchmarks/refine_calibration.py null --draws 1000 [--first 0]
    python benchmarks/refine_calibration.py drag --draws 500 [--first 0]

A ball of 66 mm and 60 g is thrown at 3 to 8 m/s and followed for 40 frames at 60 Hz. Its errors are jitter of 1 mm and
smooth errors of 0 to 3 times that, with a correlation time between two frames and the record. ``drag``: quadratic, 5e-4
to 3e-2 /m, evenly in the logarithm. Every draw is searched by ``masiv.refinement.search`` in full.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from scipy.stats import beta

FRAMES, FPS, JITTER = 40, 60.0, 1e-3
MASS, DIAMETER = 0.06, 0.066
DRAGS = ("quadratic_drag", "linear_drag")


def ball_tracks():
    """A scene of one flight, whose values are replaced by those of a draw."""
    from masiv.tracks.read import read_tracks

    folder = Path(tempfile.mkdtemp())
    times = np.arange(FRAMES) / FPS
    rows = ["t,x,y,z", *(f"{t},{4 * t},{1 + 3 * t - 4.9 * t * t},{0.5 * t}" for t in times)]
    (folder / "flight.csv").write_text("\n".join(rows))
    scene = {
        "layout": "tracks", "units": "m", "up_axis": "y",
        "bodies": {"ball": {
            "mass": MASS, "group": "balls",
            "geometry": {"sphere": DIAMETER, "units": "m", "markers_at": {"centre": [0, 0, 0]}},
        }},
        "runs": [{"file": "flight.csv", "body": "ball", "use": "fit"}],
        "columns": {"time": "t", "markers": {"centre": {"x": "x", "y": "y", "z": "z"}}},
    }  # fmt: skip
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return read_tracks(folder)


def draw(tracks, run, seed, *, with_drag):
    """The flight of draw ``seed``, and its drag [1/m]."""
    from masiv.effects.catalogue import effect_named
    from masiv.models.point_mass import PointMassModel, fly

    rng = np.random.default_rng(seed)
    drag = float(np.exp(rng.uniform(np.log(5e-4), np.log(3e-2)))) if with_drag else 0.0
    speed, elevation, azimuth = rng.uniform(3, 8), rng.uniform(0.2, 1.1), rng.uniform(0, 2 * np.pi)
    along = np.cos(elevation)
    velocity = speed * np.array([along * np.cos(azimuth), np.sin(elevation), along * np.sin(azimuth)])
    model = PointMassModel(tracks, [run])
    members = [(effect_named("quadratic_drag"), np.array([drag]))] if drag else []
    start = np.array([[[0.0, 1.0, 0.0], velocity]])
    path = fly(model.frame, model.gravity, members, start, run.times, DIAMETER)[0]
    length = float(np.exp(rng.uniform(np.log(2 / FPS), np.log(FRAMES / FPS))))
    lags = np.abs(np.subtract.outer(run.times, run.times))
    factor = np.linalg.cholesky(np.exp(-0.5 * (lags / length) ** 2) + 1e-9 * np.eye(FRAMES))
    errors = rng.normal(size=path.shape) + rng.uniform(0, 3) * factor @ rng.normal(size=path.shape)
    return replace(run, values=(path + JITTER * errors)[:, None]), drag


def searched(tracks, run, drag):
    """One row: what was named, with which probability, and the drag with its error."""
    from masiv.identification.flights import fit_flights
    from masiv.models.point_mass import PointMassModel
    from masiv.refinement.config import RefineConfig
    from masiv.refinement.search_state import SearchSettings
    from masiv.refinement.stage import refine

    model = PointMassModel(tracks, [run])
    result = refine(model, [fit_flights(model)], SearchSettings.of(RefineConfig.model_validate({"max_effects": 1})))
    body = model.drag_bodies["ball"]
    per_coefficient = body.medium_density * math.pi * body.diameter**2 / (8 * body.mass)
    row = {"drag": drag, "null": result.search.null_probability, "verdict": result.verdict,
           "named": [t.effect for t in result.accepted]}  # fmt: skip
    first = result.search.rounds[0]
    row["credible"] = sorted(e for s in first.posterior.credible_set() for e in s) if first.posterior else []
    name = "quadratic_drag.drag_coefficient"
    if "quadratic_drag" in row["named"]:
        row["value"], row["stderr"] = (x[name] * per_coefficient for x in (result.after.values, result.after.stderr))
    row["limits"] = {x.effect: x.strength for x in result.search.limits}
    if "quadratic_drag" in row["limits"]:
        row["limits"]["quadratic_drag"] *= per_coefficient
    return row


def interval(count, total):
    """Clopper-Pearson interval of a share, 95 %."""
    low = beta.ppf(0.025, count, total - count + 1) if count else 0.0
    return low, beta.ppf(0.975, count + 1, total - count) if count < total else 1.0


def share(label, count, total):
    low, high = interval(count, total)
    print(f"{label}: {count} of {total}, {100 * count / max(total, 1):.1f} % ({100 * low:.1f} to {100 * high:.1f} %)")


def summary(rows):
    """What the page has."""
    named = [r for r in rows if r["named"]]
    if not rows[0]["drag"]:
        share("named although nothing is there", len(named), len(rows))
        share("verdict nothing missing", sum(r["verdict"] == "nothing missing" for r in rows), len(rows))
        return
    share("named", len(named), len(rows))
    share("wrong name (no drag), of those named", sum(r["named"][0] not in DRAGS for r in named), len(named))
    credible = sum("quadratic_drag" in r["credible"] for r in named)
    share("true effect in the credible set, of those named", credible, len(named))
    known = [r for r in named if "value" in r]
    z = np.array([(r["value"] - r["drag"]) / r["stderr"] for r in known])
    share("within 1 standard error", int((np.abs(z) < 1).sum()), len(z))
    share("within 2 standard errors", int((np.abs(z) < 2).sum()), len(z))
    left = [r for r in rows if "quadratic_drag" in r["limits"] and not r["named"]]
    below = sum(r["drag"] <= r["limits"]["quadratic_drag"] for r in left)
    share("below the upper limit, of those not named", below, len(left))
    for low, high in itertools.pairwise(np.geomspace(5e-4, 3e-2, 7)):
        own = [r for r in rows if low <= r["drag"] < high]
        share(f"power, drag {low:.1e} to {high:.1e} /m", sum(bool(r["named"]) for r in own), len(own))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("null", "drag"))
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    from masiv import runtime
    from masiv.observations.tracks import flight_observations

    runtime.start("cpu")
    with runtime.torch_threads(1):
        tracks = ball_tracks()
        (run,) = flight_observations(tracks, "balls")
        rows = []
        for seed in range(given.first, given.first + given.draws):
            rows.append(searched(tracks, *draw(tracks, run, seed, with_drag=given.kind == "drag")))
    if given.json:
        given.json.write_text("\n".join(map(json.dumps, rows)))
    summary(rows)


if __name__ == "__main__":
    main()
