"""Motions with one effect, or with none, whose truth is known: draws for ``refine_calibration.py``.

Errors are jitter, and errors that are smooth in time (and over the body) of 0 to 3 times its size. Gravity is off by as
much as refine takes for granted. Strengths are drawn from the prior that refine gives them, or evenly in the logarithm
over what is neither invisible nor obvious.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

MAX_SMOOTH = 3.0
"""Smooth errors over jitter, at the most."""
WAVES = 64
"""Of which smooth errors are a sum."""
NARROW = (0.3, 30.0)
"""Sizes of narrow strengths, in finite-difference steps of the effect."""
FRAMES, FPS = 40, 60.0
GRAVITY = "gravity_scale.relative_change"


@dataclass(frozen=True)
class Draw:
    """What refine is given, and what it is not: truth, strengths and other parameters of ``effect`` (None: nothing
    acts)."""

    forward_model: Any
    baselines: Sequence[Any]
    config: Any
    effect: str | None
    truth: dict[str, float]


def strengths(rng: np.random.Generator, parameters: Sequence[Any], *, narrow: bool) -> dict[str, float]:
    """Of one effect: from the prior of ``Evidence.priors``, or of a size that is even in the logarithm. What is beyond
    a bound is drawn again."""
    from masiv.inference.evidence import STRENGTH_SCALES, strength_scales

    while True:
        if narrow:
            direction = rng.normal(size=len(parameters))
            steps = np.array([p.step for p in parameters])
            size = np.exp(rng.uniform(*np.log(NARROW)))
            values = size * steps * direction / np.linalg.norm(direction)
            values = np.where([p.lower >= 0 for p in parameters], np.abs(values), values)
        else:
            scale = rng.integers(STRENGTH_SCALES)
            values = np.array([rng.normal() * strength_scales(p)[scale] for p in parameters])
        if all(p.lower <= v <= p.upper for p, v in zip(parameters, values, strict=True)):
            return {p.name: float(v) for p, v in zip(parameters, values, strict=True)}


def errors(rng: np.random.Generator, points: np.ndarray, times: np.ndarray, jitter: float, reach: float) -> np.ndarray:
    """(T, N, 3) [m] at ``points`` (N, 3) and ``times`` (T,) [s]: ``jitter`` [m] and smooth errors with a correlation
    time between two instants and the record, over ``reach`` [m]."""
    shape = (len(times), *points.shape)
    length = np.exp(rng.uniform(np.log(2 * np.median(np.diff(times))), np.log(times[-1])))
    wave, rate = rng.normal(size=(WAVES, 3)) / reach, rng.normal(size=WAVES) / length
    # One set of waves an axis: axes are independent.
    smooth = np.stack(
        [
            np.cos((points @ wave.T)[None] + times[:, None, None] * rate + rng.uniform(0, 2 * np.pi, WAVES))
            @ (rng.normal(size=WAVES) * np.sqrt(2 / WAVES))
            for _ in range(3)
        ],
        axis=2,
    )
    return jitter * (rng.normal(size=shape) + rng.uniform(0, MAX_SMOOTH) * smooth)


# -- flights ----------------------------------------------------------------------------------------------------------

MASS, DIAMETER, FLIGHT_JITTER = 0.06, 0.066, 1e-3
FLIGHT_EFFECTS = ("quadratic_drag", "body_force", "gravity_scale", "periodic_force")
"""Not linear drag: its prior begins at more than what refine holds for possible in air."""


def _ball() -> tuple[Any, Any]:
    """A scene of one flight, and its run, whose values are replaced by those of a draw."""
    from masiv.observations.tracks import flight_observations
    from masiv.tracks.read import read_tracks

    with tempfile.TemporaryDirectory() as name:
        folder, times = Path(name), np.arange(FRAMES) / FPS
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
        tracks = read_tracks(folder)
    (run,) = flight_observations(tracks, "balls")
    return tracks, run


def flights(rng: np.random.Generator, *, with_effect: bool, narrow: bool) -> Draw:
    """A ball of 66 mm and 60 g, thrown at 3 to 8 m/s, for 40 frames at 60 Hz; jitter of 1 mm."""
    from masiv.identification.flights import fit_flights
    from masiv.inference.evidence import GRAVITY_SD
    from masiv.models.base import Model
    from masiv.models.point_mass import RIGID, PointMassModel, fly
    from masiv.observations.tracks import flight_noise
    from masiv.refinement.config import RefineConfig

    tracks, run = _ball()
    model = PointMassModel(tracks, [run])
    speed, elevation, azimuth = rng.uniform(3, 8), rng.uniform(0.2, 1.1), rng.uniform(0, 2 * np.pi)
    along = np.cos(elevation)
    velocity = speed * np.array([along * np.cos(azimuth), np.sin(elevation), along * np.sin(azimuth)])
    effect = str(rng.choice(FLIGHT_EFFECTS)) if with_effect else None
    truth: dict[str, float] = {}
    members = []
    if effect is not None:
        term = model.term(effect)
        truth = strengths(rng, term.strengths, narrow=narrow)
        truth |= {p.name: rng.uniform(1 / run.times[-1], FPS / 2) for p in term.others}  # a frequency
        members = model.members(Model(RIGID, "none", (effect,)), truth, run)
    gravity = model.gravity * (1 + GRAVITY_SD * rng.normal() * (effect is None or GRAVITY not in truth))
    start = np.array([[[0.0, 1.0, 0.0], velocity]])
    path = fly(model.frame, gravity, members, start, run.times, DIAMETER)[0][:, None]
    values = path + errors(rng, np.zeros((1, 3)), run.times, FLIGHT_JITTER, 1.0)
    noise = flight_noise(run.times, values[:, 0])
    std = np.full(FRAMES, noise)
    run = replace(run, values=values, noise_std=noise, residual_std=std, observation_std=std)
    model = PointMassModel(tracks, [run])
    return Draw(model, [fit_flights(model)], RefineConfig(max_effects=1), effect, truth)


# -- a clamped body ---------------------------------------------------------------------------------------------------

BODY_JITTER, POINTS, AT_REST, BODY_FRAMES = 3e-4, 4, 20, 30
"""[m]; points; frames at rest that show the noise, as a scene of tracks has it; frames after them."""


def linear(rng: np.random.Generator, *, with_effect: bool, narrow: bool) -> Draw:
    """A clamped body of four modes that is let go, seen by 4 points for 30 frames at 60 Hz; jitter of 0.3 mm."""
    from modal_body import EFFECTS, RELEASED, SIDES, ModalBody

    from masiv.inference.evidence import GRAVITY_SD
    from masiv.inference.model_fit import gauss_newton_fit
    from masiv.models.base import Model
    from masiv.models.families import Family
    from masiv.observations.base import Observation
    from masiv.refinement.config import RefineConfig

    times = np.arange(BODY_FRAMES + AT_REST) / FPS
    points = rng.uniform(0, 1, (POINTS, 3)) * SIDES - [0, *SIDES[1:] / 2]
    shaken = errors(rng, points, times, BODY_JITTER, float(SIDES[0]))
    rest, shaken, times = shaken[:AT_REST], shaken[AT_REST:], times[:BODY_FRAMES]
    noise = float(np.sqrt(((rest - rest.mean(0)) ** 2).sum(2).mean()))
    observation = Observation(
        name="0", times=times, points=points, values=np.broadcast_to(points, shaken.shape), fit_count=BODY_FRAMES,
        noise_std=noise, residual_std=np.full(BODY_FRAMES, noise),
    )  # fmt: skip
    values = {"log_stiffness": rng.uniform(-0.5, 0.5)}
    values |= dict(zip(RELEASED, rng.uniform(-1, 1, 4) * [0.05, 0.05, 0.03, 0.01], strict=True))
    model = ModalBody(observation)
    effect = str(rng.choice(EFFECTS)) if with_effect else None
    truth = strengths(rng, model.term(effect).strengths, narrow=narrow) if effect is not None else {}
    true_values = {GRAVITY: GRAVITY_SD * rng.normal(), **values, **truth}
    model = ModalBody(replace(observation, values=model.motion(true_values) + shaken))
    budget = 12 * (len(values) + 1)
    base = gauss_newton_fit(model, Model(Family("elastic", (), {}), "none"), values, budget=budget)
    return Draw(model, [base], RefineConfig(max_effects=1), effect, truth)


# -- material point method --------------------------------------------------------------------------------------------

MPM_EFFECTS = ("linear_drag", "quadratic_drag", "body_force", "gravity_scale", "viscosity")
MPM_FRAMES, MPM_FITTED = 11, 8
TRUE_PARTICLES, PARTICLES = 1600, 400


def mpm(rng: np.random.Generator, *, with_effect: bool, narrow: bool) -> Draw:
    """A thrown body of 0.8 m that lands, simulated with four times the particles of the model and another grid, 11
    frames at 24 fps; jitter of 0.2 to 1 mm. The family of its law is known; its parameters are not."""
    from refine_tracks import fits_of
    from track_cases import Case, observed

    from masiv.models.base import effect_parameters
    from masiv.observations.motion import SampledMotion
    from masiv.refinement.config import RefineConfig
    from masiv.shapes import ShapeSpec

    effect = str(rng.choice(MPM_EFFECTS)) if with_effect else None
    truth = strengths(rng, effect_parameters(effect), narrow=narrow) if effect is not None else {}
    law = {"youngs_modulus": 10 ** rng.uniform(4, 5), "poissons_ratio": rng.uniform(0.2, 0.4)}
    shape = ShapeSpec(
        kind=str(rng.choice(["capsule", "cube", "sphere", "cylinder"])), size=0.8,
        rotation_deg=tuple(rng.uniform(0, 90, 3).tolist()), clearance=rng.uniform(0.15, 0.4),
    )  # fmt: skip
    effects = {effect: {n.split(".")[1]: v for n, v in truth.items()}} if effect is not None else {}
    case = Case(
        "draw", "neo_hookean", law, effects, shape,
        (rng.uniform(-1.5, 1.5), rng.uniform(-0.5, 1.0), rng.uniform(-1.5, 1.5)), tuple(rng.uniform(-3, 3, 3).tolist()),
        MPM_FRAMES, MPM_FITTED, TRUE_PARTICLES, rng.uniform(4, 8), noise_mm=0.0,
    )  # fmt: skip
    scene, motion = observed(case)
    jitter = np.exp(rng.uniform(np.log(2e-4), np.log(1e-3)))
    shaken = motion.positions.copy()
    shaken[1:] += errors(rng, shaken[0], motion.times, jitter, rng.uniform(0.1, 0.5))[1:]
    config = RefineConfig(
        particles=PARTICLES, search_particles=PARTICLES, laws=["neo_hookean"], max_effects=1, test_fraction=0.0,
    )  # fmt: skip
    forward_model, _, fits = fits_of(scene, SampledMotion(shaken, motion.times, motion.volume), MPM_FITTED, config)
    return Draw(forward_model, fits, config, effect, truth)


SOURCES = {"flights": flights, "linear": linear, "mpm": mpm}


def draw(source: str, seed: int, *, null_fraction: float, narrow: bool = False) -> Draw:
    """Draw ``seed`` of a source, with an effect or, as often as ``null_fraction``, without."""
    rng = np.random.default_rng([list(SOURCES).index(source), seed])
    return SOURCES[source](rng, with_effect=rng.uniform() >= null_fraction, narrow=narrow)
