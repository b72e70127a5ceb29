"""Real measurements: falling balls and a silicone beam, from tracks to what the model lacks.

    python benchmarks/measured.py scenes --out DIR        # scenes that masiv reads, one folder each
    python benchmarks/measured.py balls [--json FILE]
    python benchmarks/measured.py damping --particles 400 1000 1728 --youngs 310e3 --viscosity 250
    python benchmarks/measured.py load --youngs 306.4e3 --viscosity 203
    python benchmarks/measured.py creep --duration 3.5 --particles 400 [--held-straight] [--fractions 0.1 0.2]
                                        [--effects point_mass hung_mass] [--thread 0]

The measurements are in the folder that MASIV_MEASURED names, ../shared/measured beside the repository by default. They
are public: see benchmarks/measured.md.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

OUNCE = 0.028349523125
MARKERS_AT = {"tip1": [36, 15, 0], "tip2": [24, -6, 0], "tip3": [6, 36, 0],
              "base1": [-1, -10, 94], "base2": [27.5, 40, 94], "base3": [0, 40, 94]}  # fmt: skip
"""Of the beam [mm], in the axes of its mesh; the clamped end is at z = 100. Fitted to the rest positions."""


BEAM_AT_REST = {("gravity", "a"): [20, 60], ("gravity", "b"): [20, 55],
                ("load52", "a"): [10, 35], ("load52", "b"): [10, 45]}  # fmt: skip
"""Frames in which the beam is held straight."""
THREAD = 0.17
"""Length [m] of a thread from which the fit of the load starts; it swings at 1.2 Hz."""
LOAD_IGNORED = 0.1
"""How long [s] after the release the loaded tip stops and goes (0.31, 0.18, 0.37 m/s after 28, 48 and 68 ms)."""


def data_folder() -> Path:
    """Where the measurements are, whether or not they are there."""
    return Path(os.environ.get("MASIV_MEASURED", Path(__file__).parents[2] / "shared" / "measured"))


def write_balls(source: Path, out: Path) -> Path:
    """A scene of the ball drops in ``source``: drop 1 of each ball is fitted, drop 2 held out."""
    out.mkdir(parents=True, exist_ok=True)
    _link(source / "ball_drops.csv", out)
    bodies, runs = {}, []
    with (source / "balls.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            name = row["ball"]
            bodies[name] = {
                "mass": float(row["weight_oz"]) * OUNCE,
                "group": "balls",
                "geometry": {
                    "sphere": float(row["circumference_cm"]) / math.pi, "units": "cm",
                    "markers_at": {"centre": [0, 0, 0]},
                },
            }  # fmt: skip
            runs += [
                {"file": "ball_drops.csv", "body": name, "select": {"ball": name, "drop": drop},
                 "use": "fit" if drop == 1 else "hold_out"}
                for drop in (1, 2)
            ]  # fmt: skip
    _save(out, {
        "layout": "tracks", "units": "m", "up_axis": "y",
        "columns": {"time": "time_s", "markers": {"centre": {"y": "height_m"}}}, "bodies": bodies, "runs": runs,
    })  # fmt: skip
    return out


def write_beam(source: Path, out: Path, held_straight: bool = True) -> Path:
    """A scene of the silicone beam in ``source``: _a is fitted, _b held out, under its own weight and with a load."""
    out.mkdir(parents=True, exist_ok=True)
    _link(source / "beam.stl", out)
    runs = []
    for kind, condition in (("gravity", ""), ("load52", "load52")):
        ignored = {} if not condition else {"ignore_after_release": LOAD_IGNORED}
        for repeat, use in (("a", "fit"), ("b", "hold_out")):
            name = f"beam_{kind}_V2_{repeat}.csv"
            _link(source / name, out)
            runs.append({"file": name, "name": f"{kind}_{repeat}", "condition": condition, "use": use,
                         "rest_frames": BEAM_AT_REST[kind, repeat], "held_straight": held_straight,
                         **ignored})  # fmt: skip
    body = {
        "density": 1070,
        "poissons_ratio": 0.499,
        "geometry": {"mesh": "beam.stl", "units": "mm", "markers_at": MARKERS_AT},
        "clamp": {"half_space": {"normal": [0, 0, -1], "height": -100}, "markers": ["base1", "base2", "base3"]},
    }
    _save(out, {"layout": "tracks", "units": "m", "up_axis": "x", "bodies": {"beam": body}, "runs": runs})
    return out


def _link(file: Path, folder: Path) -> None:
    if not (folder / file.name).exists():
        (folder / file.name).symlink_to(file.resolve())


def _save(folder: Path, document: dict) -> None:
    (folder / "scene.yaml").write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")


def ball_scene(source: Path):
    """The ``Tracks`` of the ball drops in ``source``."""
    from masiv.tracks.read import read_tracks

    with tempfile.TemporaryDirectory() as folder:
        return read_tracks(write_balls(source, Path(folder)))


def balls(source: Path) -> dict:
    """What refine finds in the ball drops, and what one free gravity a ball would have looked like."""
    from masiv.inference.model_fit import gauss_newton_fit
    from masiv.models.base import Model
    from masiv.refinement.config import RefineConfig
    from masiv.refinement.from_tracks import refine_group
    from masiv.refinement.search_state import SearchSettings

    tracks = ball_scene(source)
    began = time.perf_counter()
    refined = refine_group(tracks, "balls", SearchSettings.of(RefineConfig.model_validate({})))
    seconds = time.perf_counter() - began
    simulation, result = refined.forward_model, refined.search
    first = {t.candidate.effect: t for t in result.rounds[0].trials}
    alike = simulation.by_body
    rows = {
        "before": alike(result.before.model, result.before.values, fitted=False),
        "after": alike(result.after.model, result.after.values, fitted=False),
        "one drag coefficient for all": _held(simulation, first, "quadratic_drag"),
        "one gravity for all": _held(simulation, first, "gravity_scale"),
    }
    each = simulation.scoped_term("gravity_scale", simulation.bodies, each=True)
    start = {p.name: -0.1 for p in each.parameters} | result.before.values
    model = Model(result.before.model.family, "none", (each.name,))
    trap = gauss_newton_fit(simulation, model, start, budget=20 * (len(start) + 1))
    rows["one gravity each, which cannot be"] = alike(model, trap.values, fitted=False)
    terms = [simulation.term(n) for n in result.after.model.effects]
    own = {
        t.bodies[0] if t.bodies else "all": [result.after.values[t.parameters[0].name],
                                             result.after.stderr[t.parameters[0].name]]
        for t in terms
    }  # fmt: skip
    return {
        "accepted": list(result.after.model.effects), "own": own, "validation_mm": rows,
        "refused": {n: b.objections for n, b in refined.bodies.items() if b.objections},
        "shared": [
            {"bodies": s.term.bodies,
             "values": {n: [v, s.fitted.stderr[n]] for n, v in s.fitted.values.items() if n.startswith(s.term.effect)},
             "spread": s.strength_std, "log_bayes_factor": s.log_bayes_factor,
             "validation_mm": alike(s.fitted.model, s.fitted.values, "hold_out")}
            for s in refined.shared
        ],
        "gravity_each": [9.8 * (1 + trap.values[p.name]) for p in each.parameters],
        "information_gain_of_gravity_each": result.before.bic(trap.samples) - trap.bic(trap.samples),
        "trials": {
            n: {"fit_mm": t.fitted.fit_mm, "validation_mm": t.fitted.validation_mm, "impossible": list(t.impossible),
                "log_bayes_factor": t.log_bayes_factor}
            for n, t in first.items()
        },
        "gravity": 9.8 * (1 + first["gravity_scale"].fitted.values["gravity_scale.relative_change"])
        if "gravity_scale" in first else None,
        "flights": simulation.rollouts, "seconds": seconds,
    }  # fmt: skip


def damping(
    source: Path, particles: list[int], youngs: float, viscosity: float, duration: float, courant: float
) -> list[dict]:
    """Frequency and decay of the beam's swing with and without viscosity, by the number of particles: what of the decay
    is the simulator's own; and those that were measured."""
    import numpy as np
    import torch
    from dissipation import swing

    from masiv.effects.catalogue import effect_named
    from masiv.materials.classical import ClassicalLaw
    from masiv.models.marked_body import marked_body
    from masiv.mpm.config import SimulatorConfig
    from masiv.tracks.read import read_tracks

    with tempfile.TemporaryDirectory() as folder:
        tracks = read_tracks(write_beam(source, Path(folder)))
    law = ClassicalLaw("neo_hookean", youngs_modulus=youngs, poissons_ratio=0.45)
    config = SimulatorConfig.model_validate({"courant_number": courant, "max_substeps_per_frame": 4000})
    times, rows = np.arange(0, duration, 2.5e-3), []
    for name in ("gravity_a", "gravity_b"):
        run = next(r for r in tracks.runs if r.name == name)
        seen = run.between(run.release + 0.03, run.release + duration)
        hz, rate, amplitude = swing(seen.elapsed, seen.positions[:, 0, 0], 7.5)
        rows.append({"measured": name, "hz": hz, "decay_per_s": rate, "amplitude_mm": 1e3 * amplitude})
    for count in particles:
        body = marked_body(tracks, tracks.runs[0], config, particle_spacing=(9e-5 / count) ** (1 / 3), speed=0.3)
        for eta in (0.0, viscosity):  # a fine grid and much viscosity need a smaller Courant number
            began = time.perf_counter()
            members = ((effect_named("viscosity"), torch.tensor([eta])),)
            acting = body.effects(members, body.context(float(times[-1]), float(times[-1]) / (len(times) - 1)))
            tip = body.markers_to_world(body.run(law, times, acting)[1])[:, 0, 0]
            hz, rate, amplitude = swing(times[12:], tip[12:], 7.5)
            rows.append({
                "particles": len(body.particles), "grid_mm": 1e3 * body.spacing, "viscosity": eta, "hz": hz,
                "decay_per_s": rate, "amplitude_mm": 1e3 * amplitude, "seconds": time.perf_counter() - began,
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
    return rows


def load(source: Path, youngs: float, viscosity: float, particles: int, courant: float, what: list[str]) -> list[dict]:
    """The loaded beam with one effect at the middle of its end, law and viscosity known: what is left of load52_a, from
    0.1 to 0.6 s after its release, and of load52_b, which is held out."""
    from masiv.identification.tracks import clamped_body_model
    from masiv.inference.model_fit import gauss_newton_fit
    from masiv.models.base import Model
    from masiv.models.families import family_of
    from masiv.mpm.config import SimulatorConfig
    from masiv.tracks.config import TracksConfig
    from masiv.tracks.read import read_tracks

    with tempfile.TemporaryDirectory() as folder:
        tracks = read_tracks(write_beam(source, Path(folder)))
    law = {"poissons_ratio": 0.45, "youngs_modulus": youngs, "viscosity.viscosity": viscosity}
    config = SimulatorConfig.model_validate({"courant_number": courant, "max_substeps_per_frame": 4000})
    begins = {"nothing": {}, "point_mass": {"mass": 0.06}, "point_force": {"force_y": -0.6, "force_x": 0, "force_z": 0}}
    rows = []
    for name in what:
        began = time.perf_counter()
        settings = TracksConfig(particles=particles, duration=0.6)
        simulation = clamped_body_model(tracks, "load52", settings, config, known=law)
        effects = ("viscosity",) if name == "nothing" else ("viscosity", name)
        values = {f"{name}.{n}": float(v) for n, v in begins[name].items()}
        held: frozenset[str] = frozenset()
        if name != "nothing":
            place = max(simulation.term(name).guesses, key=lambda guess: guess[2])  # along the body, from the clamp
            values |= dict(zip((f"{name}.{axis}" for axis in "xyz"), place, strict=True))
            held = frozenset(f"{name}.{axis}" for axis in "xyz")
        model = Model(family_of("neo_hookean", 1070, law), "none", effects)
        fitted = gauss_newton_fit(simulation, model, values, budget=60, held=held)
        rows.append({
            "effect": name, "load52_a_mm": fitted.fit_mm, "load52_b_mm": fitted.validation_mm,
            "values": {n: [v, fitted.stderr.get(n)] for n, v in fitted.values.items()},
            "rollouts": simulation.rollouts, "seconds": time.perf_counter() - began,
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return rows


def creep(
    source: Path,
    particles: int,
    courant: float,
    duration: float,
    youngs: float,
    held_straight: bool,
    fractions: Sequence[float],
    effects: Sequence[str],
    thread: float,
) -> dict:
    """Law with Maxwell branches from gravity_a alone, over ``duration`` [s] after its release, with ``fractions`` of
    the branches to start from and the modulus ``youngs`` [Pa] at the frequency of its swing; with the best one, each
    of ``effects``, tied to the middle of the end of the loaded beam, from load52_a; a hung mass on a ``thread`` [m] of
    that length at first, fixed if it is 0. gravity_b and load52_b are held out. moduli: of uniaxial tension, three
    times those of shear."""
    import torch

    from masiv.effects.relaxation import BRANCHES, TIMES, shear_moduli
    from masiv.identification.tracks import clamped_body_model
    from masiv.inference.model_fit import gauss_newton_fit
    from masiv.models.base import Model
    from masiv.models.families import family_of
    from masiv.mpm.config import SimulatorConfig
    from masiv.tracks.config import TracksConfig
    from masiv.tracks.read import read_tracks

    with tempfile.TemporaryDirectory() as folder:
        tracks = read_tracks(write_beam(source, Path(folder), held_straight))
    known = {"poissons_ratio": 0.45}
    config = SimulatorConfig.model_validate({"courant_number": courant, "max_substeps_per_frame": 4000})
    settings = TracksConfig(particles=particles, duration=duration)
    family = family_of("neo_hookean", 1070, known)
    names = [f"relaxation.fraction_{i + 1}" for i in range(BRANCHES)]
    names += [f"relaxation.time_{i + 1}" for i in range(BRANCHES)]

    def row(began: float, simulation, fitted) -> dict:
        out = {
            "fit_mm": fitted.fit_mm, "held_out_mm": fitted.validation_mm,
            "values": {n: [v, fitted.stderr.get(n)] for n, v in fitted.values.items()},
            "rollouts": simulation.rollouts, "seconds": time.perf_counter() - began,
        }  # fmt: skip
        print(json.dumps(out), flush=True)
        return out

    fits, rows = [], []
    swing = 2 * math.pi * 7.77  # of gravity_a [rad/s], at which the law alone has the modulus ``youngs``
    for fraction in fractions:
        began = time.perf_counter()
        simulation = clamped_body_model(tracks, "", settings, config, known=known)
        start = dict(zip(names, [fraction] * BRANCHES + list(TIMES), strict=True))
        start["youngs_modulus"] = youngs / (1 + sum(fraction / (1 + (swing * t) ** -2) for t in TIMES))
        fits.append(gauss_newton_fit(simulation, Model(family, "none", ("relaxation",)), start, budget=120))
        rows.append(row(began, simulation, fits[-1]))
    law = min(fits, key=lambda fitted: fitted.fit_mm)
    found: dict = {"gravity": rows, "moduli": []}
    theta = torch.tensor([law.values[n] for n in names], dtype=torch.float64)
    shear = law.values["youngs_modulus"] / (2 * (1 + known["poissons_ratio"]))
    frequencies = torch.tensor([0.03, 0.1, 0.3, 1.0, 3.0, 4.3, 7.8, 10.0], dtype=torch.float64)
    for hz, storage, loss in zip(frequencies.tolist(), *shear_moduli(theta, shear, frequencies), strict=True):
        found["moduli"].append({"hz": hz, "storage_pa": 3 * float(storage), "loss_pa": 3 * float(loss)})
        print(json.dumps(found["moduli"][-1]), flush=True)

    given = known | {n: law.values[n] for n in ("youngs_modulus", *names)}
    loads = {}
    for name in effects:
        start = {"hung_mass.length": thread} if name == "hung_mass" else {}
        began = time.perf_counter()
        simulation = clamped_body_model(tracks, "load52", settings, config, known=given)
        place = max(simulation.term(name).guesses, key=lambda guess: guess[2])  # along the body, from the clamp
        at = dict(zip((f"{name}.{axis}" for axis in "xyz"), place, strict=False))
        model = Model(family_of("neo_hookean", 1070, given), "none", ("relaxation", name))
        held = frozenset(at) | (frozenset() if thread else start.keys())  # without a thread it is fixed
        load = gauss_newton_fit(simulation, model, {f"{name}.mass": 0.03, **start, **at}, budget=60, held=held)
        loads[name] = row(began, simulation, load)
    return found | {"load52": loads}


def _held(simulation, trials: dict, name: str) -> dict | None:
    if name not in trials:
        return None
    fitted = trials[name].fitted
    return simulation.by_body(fitted.model, fitted.values, "hold_out")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="balls", choices=["scenes", "balls", "damping", "load", "creep"])
    parser.add_argument("--out", type=Path, default=Path("measured_scenes"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--particles", type=int, nargs="+", default=[400, 1000])
    parser.add_argument("--youngs", type=float, default=310e3, help="[Pa]")
    parser.add_argument("--viscosity", type=float, default=250.0, help="[Pa s]")
    parser.add_argument("--duration", type=float, default=0.6, help="[s]")
    parser.add_argument("--courant", type=float, default=0.6)
    parser.add_argument("--held-straight", action="store_true", help="of creep: the shape before the release is known")
    parser.add_argument("--fractions", type=float, nargs="+", default=[0.1, 0.2], help="of creep: starts of its fit")
    parser.add_argument("--effects", nargs="+", help="of load and creep")
    parser.add_argument("--thread", type=float, default=THREAD, help="of creep: length at first [m]; 0: it is fixed")
    asked = parser.parse_args()
    source = data_folder()
    if not source.is_dir():
        print(f"no measured data in {source}: set MASIV_MEASURED to the folder that holds ball_drops")
        return
    if asked.what == "scenes":
        print(write_balls(source / "ball_drops", asked.out / "balls"))
        print(write_beam(source / "silicone_beam", asked.out / "beam"))
        return
    import torch

    from masiv import runtime

    runtime.start("cpu")
    torch.set_num_threads(1)
    if asked.what == "damping":
        found = damping(
            source / "silicone_beam", asked.particles, asked.youngs, asked.viscosity, asked.duration, asked.courant
        )
    elif asked.what == "load":
        found = load(
            source / "silicone_beam", asked.youngs, asked.viscosity, asked.particles[0], asked.courant,
            asked.effects or ["point_mass", "point_force"],
        )  # fmt: skip
    elif asked.what == "creep":
        found = creep(
            source / "silicone_beam",
            asked.particles[0],
            asked.courant,
            asked.duration,
            asked.youngs,
            asked.held_straight,
            asked.fractions,
            asked.effects or ["point_mass", "hung_mass"],
            asked.thread,
        )
    else:
        found = balls(source / "ball_drops")
    text = json.dumps(found, indent=1)
    if asked.json:
        asked.json.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
