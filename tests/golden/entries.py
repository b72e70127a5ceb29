"""What golden.py records: each entry runs a small job and picks its numbers.

The keys are this folder's own, so that a file does not change when the project gives a key or a parameter another name:
then only the functions below that read the project's files do.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
Numbers = dict[str, Any]

SAMPLE = {
    "reconstruct": {
        "processes": 1, "gaussians": 300, "hull_resolution": 24, "crop_side": 48, "iterations": 150, "width": 16,
        "depth": 1,
    },
    "trajectory": {"particle_count": 400, "fill_resolution": 24, "iterations": 30},
    "identify": {"processes": 1, "start": "jelly", "contact": "sticky", "search_particles": 150, "iterations": 4},
    # With so little effort nothing is certain. An effect is accepted anyway, so that the twin gets one.
    "refine": {
        "processes": 1, "particles": 200, "search_particles": 100, "families": 1, "laws": ["neo_hookean"],
        "effects": ["linear_drag", "body_force", "gravity_scale"], "baseline_rollouts": 6, "shortlist": 2,
        "max_effects": 1, "tracking_error": 0, "min_explained": 0, "max_null_probability": 0.999999,
    "min_predictive_p": 0, },
}  # fmt: skip
BAR = {
    "simulator": {"courant_number": 0.6, "max_substeps_per_frame": 4000},
    "tracks": {"particles": 64, "duration": 0.22, "rollouts": 12},
    "refine": {
        "processes": 1, "max_effects": 1, "shortlist": 2, "effects": ["viscosity", "linear_drag", "gravity_scale"]
    },
}  # fmt: skip
BAR_LOAD = {"refine": {"shortlist": 1, "effects": ["point_mass", "gravity_scale"]}}
CASE = {"processes": 1, "particles": 200, "search_particles": 100, "baseline_rollouts": 12, "shortlist": 2}
CASE_PARTICLES = 600
"""Particles of the simulation that takes the place of a measurement."""


def sample(folder: Path) -> Numbers:
    """identify, evaluate, refine and simulate of the sample; three frames and a camera are held out."""
    run, settings = folder / "run", written(folder / "settings.yaml", SAMPLE)
    scene = ROOT / "assets/sample"
    masiv("identify", scene, "--out", run, "--config", settings, "--fit-frames", 9, "--holdout-camera", 8)
    found: Numbers = {"identify": {**twin_of_video(run), **metrics(run), **material(run), **motions(run)}}
    masiv("evaluate", run, "--truth", scene / "gt")
    found["evaluate"] = evaluation(run)
    masiv("refine", run)
    found["refine"] = refined(loaded(run / "refine.json"))
    found["after"] = {**twin_of_video(run), **metrics(run), **material(run), **motions(run)}
    found["after"]["held_out_trajectory"] = digest(run / "held_out/trajectory.npz", "positions")
    masiv("simulate", run, "--frames", 5, "--velocity=1,2,0", "--out", folder / "novel")
    found["simulate"] = digest(folder / "novel/rollout.npz", "positions")
    return found


def tracks_body(folder: Path) -> Numbers:
    """A clamped bar: its law, its damping, and a mass that half of its runs carry; one run of each kind is held out."""
    run, scene = folder / "run", HERE / "bar"
    masiv("identify", scene, "--out", run, "--config", written(folder / "settings.yaml", BAR))
    found: Numbers = {"identify": {**twin_of_tracks(run), "runs": run_errors(run)}}
    masiv("refine", run)
    found["refine"] = refined(loaded(run / "refine.json"))
    masiv("refine", run, "--condition", "load", "--config", written(folder / "load.yaml", BAR_LOAD))
    found["refine_load"] = refined(loaded(run / "refine.load.json"))
    found["after"] = {**twin_of_tracks(run), "runs": run_errors(run)}
    novel = "--condition", "load", "--without", "viscosity", "--out", folder / "novel"
    masiv("simulate", run, "--frames", 20, *novel)
    found["simulate"] = {key: digest(folder / "novel/rollout.npz", key) for key in ("positions", "markers")}
    return found


def tracks_group(folder: Path) -> Numbers:
    """Three balls that fall through air, refined together."""
    run = folder / "run"
    masiv("identify", HERE / "balls", "--out", run)
    found: Numbers = {"identify": {**twin_of_tracks(run), "runs": run_errors(run)}}
    masiv("refine", run, "--group")
    found["refine"] = refined(loaded(run / "refine.json"))
    found["after"] = {**twin_of_tracks(run), "runs": run_errors(run)}
    masiv("simulate", run, "--frames", 20, "--gravity=0,-1.6,0", "--out", folder / "moon")
    found["simulate"] = {key: digest(folder / "moon/rollout.npz", key) for key in ("positions", "markers")}
    return found


def track_case(name: str, settings: dict[str, Any], folder: Path) -> Numbers:
    """refine of a case of benchmarks/refine_tracks.py, with few particles."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from refine_tracks import cases
    from track_cases import observed

    from masiv import runtime
    from masiv.identification.config import IdentifyConfig
    from masiv.mpm.config import SimulatorConfig
    from masiv.observations.motion import SampledMotion
    from masiv.refinement.config import RefineConfig
    from masiv.refinement.document import document
    from masiv.refinement.from_video import Recording, refine_recordings

    runtime.start("cpu")
    case = replace(next(c for c in cases() if c.name == name), particles=CASE_PARTICLES)
    config = RefineConfig.model_validate({**CASE, "laws": [case.law], **settings})
    scene, motion = observed(case)
    fitted = SampledMotion(motion.positions[: case.fit_frames], motion.times[: case.fit_frames], motion.volume)
    run = Recording("0", scene, fitted, motion, case.fit_frames)
    result = refine_recordings([run], IdentifyConfig.model_validate({}), SimulatorConfig.model_validate({}), config)
    after = result.after
    return {
        "observed": digest_of(motion.positions),
        **refined(document(result)),
        "values": by_parameter(after.values),
        "stderr": by_parameter(after.stderr),
    }


ENTRIES = {
    "sample": sample,
    "tracks_body": tracks_body,
    "tracks_group": tracks_group,
    "case_control_elastic": partial(
        track_case, "control_elastic",
        {
            "families": 2, "laws": ["neo_hookean", "von_mises", "newtonian"],
            "effects": ["linear_drag", "body_force"],
        },
    ),
    "case_linear_drag_elastic": partial(
        track_case, "linear_drag_elastic",
        {"max_effects": 2, "effects": ["linear_drag", "quadratic_drag", "body_force"]},
    ),
    "case_restitution_stiff": partial(
        track_case, "restitution_stiff", {"max_effects": 1, "effects": ["restitution", "viscosity", "ground_height"]}
    ),
    "case_hidden_obstacle_elastic": partial(
        track_case, "hidden_obstacle_elastic", {"max_effects": 1, "effects": ["hidden_obstacle", "body_force"]}
    ),
}  # fmt: skip


def masiv(*arguments: object) -> None:
    """Run a command in a process of its own. Raises CalledProcessError."""
    command = [sys.executable, "-m", "masiv.cli.main", *map(str, arguments)]
    subprocess.run(command, check=True, stdout=sys.stderr)


def written(path: Path, settings: dict[str, Any]) -> Path:
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return path


def loaded(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) if path.suffix == ".yaml" else json.loads(path.read_text())


def digest(path: Path, key: str) -> Numbers:
    with np.load(path) as arrays:
        return digest_of(arrays[key])


def digest_of(positions: np.ndarray) -> Numbers:
    """Of positions (T, Q, 3) [m]: shape, mean and standard deviation of each coordinate, hash of the float32 bytes."""
    single = np.ascontiguousarray(positions, "<f4")
    every = single.reshape(-1, 3).astype(np.float64)
    return {
        "shape": list(positions.shape),
        "mean": every.mean(0).tolist(),
        "std": every.std(0).tolist(),
        "sha256": hashlib.sha256(single.tobytes()).hexdigest(),
    }


# Readers of the project's files.


def motions(run: Path) -> Numbers:
    return {name: digest(run / f"{name}.npz", "positions") for name in ("trajectory", "rollout")}


def twin_of_video(run: Path) -> Numbers:
    twin = loaded(run / "twin.yaml")
    (body,), start = twin["bodies"], twin["initial_conditions"][0]
    return {
        "law": {"kind": body["law"]["kind"], "values": parameters(body["law"]["parameters"])},
        "velocity": start["velocity"]["value"],
        "omega": start["omega"]["value"],
        "ground": twin["boundary"]["ground"]["height"]["value"],
        "contact": twin["boundary"]["contact"],
        "volume": body["volume"]["value"],
        "effects": {e["effect"]: list(parameters(e["parameters"]).values()) for e in twin["effects"]},
    }


NAMES = {
    "youngs_modulus": "E", "poissons_ratio": "nu", "velocity_x": "vx", "velocity_y": "vy", "velocity_z": "vz",
    "omega_x": "wx", "omega_y": "wy", "omega_z": "wz", "ground_offset": "ground", "grid_change": "grid",
}  # fmt: skip
"""What this folder calls a parameter. If the project renames one, its new name gets the same value here."""


def parameters(entries: dict[str, Any]) -> Numbers:
    """Value and standard error by name, in the order of the file."""
    return {NAMES.get(name, name): [entry["value"], entry.get("stderr")] for name, entry in entries.items()}


def metrics(run: Path) -> Numbers:
    found = loaded(run / "metrics.json")
    paths, body = found["fit"], found["trajectory"]
    return {
        "pictures": pictures(found),
        "paths": {"rmse_mm": paths["trajectory_rmse_mm"], "by_frame_mm": paths["trajectory_rmse_mm_by_frame"]},
        "body": {"particles": body["particles"], "spacing": body["spacing_m"], "volume": body["volume_m3"]},
    }


def pictures(found: dict[str, Any]) -> Numbers:
    """Nearness to the pictures, of the Gaussians and of the twin."""
    keys = {"iou": "mask_iou", "psnr": "psnr_db", "psnr_box": "psnr_box_db", "psnr_in_scene": "psnr_box_in_scene_db",
            "ssim": "ssim", "ssim_box": "ssim_box", "psnr_by_frame": "psnr_box_db_by_frame"}  # fmt: skip
    parts = {
        "gaussians": found["reconstruction"]["training_views"],
        "gaussians_other_camera": found["reconstruction"]["held_out_views"],
        "twin": found["twin"]["observed"],
        "twin_later": found["twin"]["future"],
    }
    return {name: {own: part[key] for own, key in keys.items()} for name, part in parts.items()}


def material(run: Path) -> Numbers:
    found = loaded(run / "material.json")
    curves = [curve["stress_pa"] for curve in found["curves"].values()]
    return {
        "material": {
            "quantities": [[q["value"], q["stderr_percent"]] for q in found["quantities"].values()],
            "families": {f["kind"]: f["misfit_percent"] for f in found["families"]},
            "excited": list(found["excited"].values()),
            "sensitivities": [s["moved_mm"] for s in found["sensitivities"]],
            "peak_stresses": [max(curve, key=abs) for curve in curves],
        }
    }


def evaluation(run: Path) -> Numbers:
    found = loaded(run / "evaluate.json")
    names = {"trajectory": "trajectory", "twin": "twin", "rigid_flight": "rigid free flight",
             "rigid_stop": "rigid, stops at the ground"}  # fmt: skip
    keys = {"chamfer": "chamfer_1e3mm2", "chamfer_by_frame": "chamfer_1e3mm2_by_frame",
            "tracked_mm": "tracked_error_mm", "tracked_by_frame_mm": "tracked_error_mm_by_frame"}  # fmt: skip
    spans = {"fitted": "observed", "later": "future"}

    def part(row: dict[str, Any] | None) -> Numbers | None:
        return None if row is None else {own: row[key] for own, key in keys.items()}

    return {
        "chamfer_floor": found["chamfer_floor_1e3mm2"],
        "rigid_velocity": found["baseline_start"]["velocity_m_s"],
        "rigid_omega": found["baseline_start"]["omega_rad_s"],
        "motion": {
            own: {span: part(found["motion"][name][key]) for span, key in spans.items()} for own, name in names.items()
        },
        "pictures": pictures(found),
    }


def twin_of_tracks(run: Path) -> Numbers:
    twin = loaded(run / "twin.yaml")
    starts: dict[str, list[float]] = {}
    for start in twin["initial_conditions"]:
        if start["release"] is None:  # a ball: its height alone is measured
            place, velocity = start["placement"]["translation"], start["velocity"]
            starts[start["observation"]] = [place["value"][1], velocity["value"][1]]
        elif start["release"]["offsets"]:
            starts[start["observation"]] = [offset["value"] for offset in start["release"]["offsets"].values()]
    law = twin["bodies"][0]["law"] or {"kind": "rigid", "parameters": {}}
    return {
        "law": {"kind": law["kind"], "values": parameters(law["parameters"])},
        "starts": starts,
        "effects": [
            {
                "effect": e["effect"],
                "bodies": e["bodies"],
                "values": list(parameters(e["parameters"]).values()),
                "place": e["place"] and e["place"]["value"],
            }
            for e in twin["effects"]
        ],
    }


def run_errors(run: Path) -> Numbers:
    """Of each run before refine, and after it where it has been [mm]."""
    return {r["run"]: [r["before_mm"], r.get("after_mm")] for r in loaded(run / "metrics.json")["runs"]}


def refined(found: dict[str, Any]) -> Numbers:
    """refine.json. Of a refit that was not accepted the errors are enough: its parameters may be next to arbitrary."""
    errors = {"rmse_mm": "trajectory_rmse_mm", "chamfer": "chamfer_1e3mm2", "psnr": "psnr_db",
              "psnr_in_scene": "psnr_box_in_scene_db", "ssim": "ssim", "iou": "mask_iou"}  # fmt: skip
    left, proposed, force = found["unexplained"], found["next_experiment"], found["discrepancy_force"]
    of_tracks = found["condition"] is not None or bool(found["bodies"])
    return {
        "verdict": found["verdict"],
        "null_probability": found["null_probability"],
        "predictive_p": [found["predictive_p"]["before"], found["predictive_p"]["after"]],
        "laws": [found["laws"]["before"], found["laws"]["after"]],
        "law": parameters(found["law_parameters"]) if of_tracks else {},
        "noise_mm": found["noise_floor_mm"],
        "grid_mm": [found["discretization_mm"]["fit"], found["discretization_mm"]["validation"]],
        "residual_mm": [found["residual_mm"]["fit"], found["residual_mm"]["validation"]],
        "residual_over_sigma": [found["reduced_chi"]["before"], found["reduced_chi"]["after"]],
        "ranking": [
            {
                "effect": c["effect"],
                "scope": c.get("scope", "all"),
                "explained": c["explained"],
                "strength": [c["theta"], c["stderr"]],
                "probability": c["probability"],
            }
            for c in found["candidates"]
        ],
        "rounds": [
            {
                "effects": r["base"]["effects"],
                "refits": [
                    {
                        "law": t["law"],
                        "effect": t["effect"],
                        "scope": t.get("scope", "all"),
                        "rmse_mm": [t["fit_rmse_mm"], t["validation_rmse_mm"]],
                        "log_bayes_factor": t["log_bayes_factor"],
                        "accepted": t["accepted"],
                        "impossible": len(t["impossible"]),
                    }
                    for t in r["refits"]
                ],
            }
            for r in found["rounds"]
        ],
        "accepted": [
            {
                "effect": a["effect"],
                "bodies": a.get("bodies", []),
                "values": list(a["theta"].values()),
                "stderr": list(a["stderr"].values()),
                "instead": a["indistinguishable_from"],
            }
            for a in found["accepted"]
        ],
        "smooth_force_mm": force and [force["fit_rmse_mm"], force["validation_rmse_mm"]],
        **{
            when: {
                span: {own: found[when][span][key] for own, key in errors.items() if key in found[when][span]}
                for span in ("fit", "validation", "test")
                if span in found[when]
            }
            for when in ("before", "after")
        },
        "left_mm": [left["rmse_mm"], left["worst_distance_mm" if of_tracks else "worst_instant_rmse_mm"]],
        "next": proposed
        and {
            "between": proposed["distinguishes"],
            "velocity": proposed["initial_velocity"]["value"],
            "omega": proposed["initial_omega"]["value"],
            "difference_mm": [proposed["predicted_difference_mm"], proposed["present_difference_mm"]],
        },
        "runs": {
            r["observation"]: [next(iter(r[when].values())) for when in ("before_mm", "after_mm")]
            for r in found["observations"]
            if of_tracks
        },
        "bodies": {
            name: [b["verdict"], b["effects"], b["validation_mm"]["before"], b["validation_mm"]["after"]]
            for name, b in found.get("bodies", {}).items()
        },
        "shared": [
            [s["effect"], s["bodies"], s["value"], s["stderr"], s["std_between_bodies"], s["validation_rmse_mm"]]
            for s in found.get("shared", [])
        ],
    }


def by_parameter(values: dict[str, float]) -> Numbers:
    """Values of law, start and grid by this folder's names, those of an effect as a list."""
    found: Numbers = {}
    for name, value in values.items():
        effect, _, parameter = name.partition(".")
        if parameter:
            found.setdefault(effect, []).append(value)
        else:
            own = name.split("@")[0]
            found[NAMES.get(own, own)] = value
    return found
