"""refine.json and refine.npz made by hand."""

from __future__ import annotations

import json

import numpy as np

from masiv.refinement.answer import SCHEMA

ERRORS = {
    "fit": {"frames": [0, 11], "trajectory_rmse_mm": 10.7, "chamfer_1e3mm2": 0.31},
    "validation": {"frames": [12, 15], "trajectory_rmse_mm": 40.2},
}


def document(**changes):
    refit = {
        "law": "neo_hookean", "effect": "linear_drag", "explained": 0.81, "fit_rmse_mm": 4.2,
        "validation_rmse_mm": 13.1,
        "parameters": {"rate": {"value": 0.72, "stderr": 0.02}}, "log_bayes_factor": 900.0, "accepted": True,
        "converged": True, "impossible": [],
    }  # fmt: skip
    refused = refit | {"effect": "swirl", "accepted": False, "impossible": ["it <cannot> be"], "parameters": {}}
    whole = {
        "schema": SCHEMA, "null_probability": 0.0021, "predictive_p": {"before": 0.004, "after": 0.6},
        "unknown_probability": 0.03, "test": {"after": {"rmse_mm": 15.0, "expected_rmse_mm": 17.5, "log_density": 3.0}},
        "credible_set": [{"effects": ["linear_drag"], "probability": 0.97}],
        "upper_limits": [{"effect": "restitution", "scope": "all", "strength": 0.0345, "unit": "1", "motion_mm": 2.25,
                          "determined": True}], "noise_floor_mm": 2.5,
        "observation_error_mm": {"fit": 2.6, "validation": 2.7}, "discretization_mm": {"fit": 3.0, "validation": 4.0},
        "grid_change": {"before": 0.4, "after": 0.625},
        "residual_mm": {"fit": 10.7, "validation": 40.2},
        "candidates": [
            {"effect": "linear_drag", "explained": 0.81, "theta": 0.7, "unit": "1/s", "stderr": 0.02,
             "parameters": {"rate": 0.7}, "probability": 0.97, "looks_like": "slows & slows"},
        ],
        "accepted": [{"effect": "linear_drag", "theta": {"rate": 0.7234}, "stderr": {"rate": 0.0213},
                      "unit": {"rate": "1/s"}, "indistinguishable_from": ["quadratic_drag"]}],
        "before": ERRORS,
        "after": {"fit": ERRORS["fit"] | {"trajectory_rmse_mm": 4.2},
                  "validation": ERRORS["validation"] | {"trajectory_rmse_mm": 13.1}},
        "unexplained": {"rmse_mm": 5.0, "noise_floor_mm": 2.5, "worst_time_s": 0.6, "worst_instant_rmse_mm": 14.0,
                        "rmse_mm_by_instant": {"run": [1.0]}, "worst_place_at_start_m": [0.1, 0.2, 0.3],
                        "worst_place_rmse_mm": 9.0},
        "verdict": "effect added", "laws": {"before": "neo_hookean", "after": "neo_hookean"},
        "discrepancy_force": None,
        "rounds": [{"base": {"law": "neo_hookean", "effects": []}, "refits": [refit, refused]}],
        "next_experiment": {
            "distinguishes": ["linear_drag", "quadratic_drag"],
            "initial_velocity": {"value": [1.5, 0.0, 0.0], "unit": "m/s"},
            "initial_omega": {"value": [0.0, 4.0, 0.0], "unit": "rad/s"}, "predicted_difference_mm": 61.0,
            "present_difference_mm": 3.0,
        },
        "rollouts": 88,
    }  # fmt: skip
    return whole | changes


def fields(instants=16, fitted=12, particles=90):
    generator = np.random.default_rng(0)
    positions = generator.uniform(0, 0.3, (particles, 3)).astype(np.float32)
    growth = np.linspace(0.001, 0.04, instants)[:, None, None]
    before = (growth * np.array([1.0, 0.2, 0.0]) + 1e-4 * generator.normal(size=(instants, particles, 3))).astype("f4")
    return {
        "observations": np.array(["run"]), "before@run": before, "after@run": 0.3 * before, "points@run": positions,
        "observed@run": np.tile(positions, (instants, 1, 1)),
        "times@run": np.arange(1, instants + 1) / 24, "fit_count@run": np.array(fitted),
        "test_count@run": np.array((instants - fitted) // 2),
    }  # fmt: skip


def write(run, found, arrays):
    (run / "refine.json").write_text(json.dumps(found))
    np.savez(run / "refine.npz", **arrays)
