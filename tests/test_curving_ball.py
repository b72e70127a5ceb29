"""Balls whose flight is no parabola: the lift of a spinning ball, and a drag that falls at a critical speed, are found
in tracks of their flights."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from masiv.refinement.config import RefineConfig
from masiv.refinement.from_tracks import refine_group
from masiv.refinement.search_state import SearchSettings
from masiv.tracks.read import read_tracks

pytestmark = pytest.mark.usefixtures("taichi")

LIFT_RATE = np.array([0.0, 0.5, -0.3])
"""k [1/s] of v' = k x v + g."""
GRAVITY = np.array([0.0, -9.8, 0.0])
NOISE = 2e-3


def tracks_of_curving_balls(folder):
    """Two balls, each thrown twice, with exact flights and white noise."""
    random = np.random.default_rng(5)
    t = np.arange(0, 1.0, 1 / 50)
    rows, runs = ["ball,throw,t,x,y,z"], []
    for ball, speed in (("red", 9.0), ("blue", 7.0)):
        for throw, heading in ((1, 0.3), (2, -0.4)):
            start = [0, 1.5, 0, speed * np.cos(heading), 4.0, speed * np.sin(heading)]
            path = solve_ivp(
                lambda _, s: [*s[3:], *(np.cross(LIFT_RATE, s[3:]) + GRAVITY)],
                (0, t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-10,
            ).y[:3].T  # fmt: skip
            path = path + random.normal(0, NOISE, path.shape)
            rows += [f"{ball},{throw},{now},{x},{y},{z}" for now, (x, y, z) in zip(t, path, strict=True)]
            runs.append({"file": "throws.csv", "body": ball, "select": {"ball": ball, "throw": throw},
                         "use": "fit" if throw == 1 else "hold_out"})  # fmt: skip
    (folder / "throws.csv").write_text("\n".join(rows))
    one = {
        "mass": 0.06, "group": "balls",
        "geometry": {"sphere": 0.066, "units": "m", "markers_at": {"centre": [0, 0, 0]}},
    }  # fmt: skip
    (folder / "scene.yaml").write_text(yaml.safe_dump({
        "layout": "tracks", "units": "m", "up_axis": "y", "bodies": {"red": one, "blue": dict(one)}, "runs": runs,
        "columns": {"time": "t", "markers": {"centre": {"x": "x", "y": "y", "z": "z"}}},
    }))  # fmt: skip
    return read_tracks(folder)


@pytest.mark.slow
def test_the_lift_of_spinning_balls_is_named_and_measured(tmp_path):
    tracks = tracks_of_curving_balls(tmp_path)
    config = RefineConfig.model_validate({"effects": ["magnus", "body_force", "quadratic_drag", "linear_drag"]})
    after = refine_group(tracks, "balls", SearchSettings.of(config)).search.after
    assert after.model.effects == ("magnus",)
    for axis, true in zip("xyz", LIFT_RATE, strict=True):
        name = f"magnus.lift_rate_{axis}"
        assert abs(after.values[name] - true) < 4 * after.stderr[name]
        assert after.stderr[name] < 0.05
    assert after.validation_mm < 3 * NOISE * 1e3


CRITICAL = 1.5e5
BELOW, ABOVE = 0.5, 0.15


def tracks_of_fast_balls(folder):
    """Two balls of different size that fall through their critical speed, each twice."""
    random = np.random.default_rng(7)
    t = np.arange(0, 3.0, 1 / 60)
    rows, runs, bodies = ["ball,fall,t,y"], [], {}
    for ball, diameter, mass in (("large", 0.22, 0.35), ("small", 0.15, 0.2)):
        geometry = {"sphere": diameter, "units": "m", "markers_at": {"centre": [0, 0, 0]}}
        bodies[ball] = {"mass": mass, "group": "balls", "geometry": geometry}
        rate = 1.2 * np.pi * diameter**2 / (8 * mass)
        critical = CRITICAL * 1.8e-5 / (1.2 * diameter)

        def falls(_, s, rate=rate, critical=critical):
            share = (abs(s[1]) / critical) ** 8
            drag = rate * (BELOW + (ABOVE - BELOW) * share / (1 + share))
            return [s[1], -9.8 - drag * abs(s[1]) * s[1]]

        for fall, speed in ((1, 0.0), (2, -4.0)):
            path = solve_ivp(falls, (0, t[-1]), [40.0, speed], t_eval=t, rtol=1e-10, atol=1e-10).y[0]
            path = path + random.normal(0, NOISE, path.shape)
            rows += [f"{ball},{fall},{now},{y}" for now, y in zip(t, path, strict=True)]
            runs.append({"file": "falls.csv", "body": ball, "select": {"ball": ball, "fall": fall},
                         "use": "fit" if fall == 1 else "hold_out"})  # fmt: skip
    (folder / "falls.csv").write_text("\n".join(rows))
    (folder / "scene.yaml").write_text(yaml.safe_dump({
        "layout": "tracks", "units": "m", "up_axis": "y", "bodies": bodies, "runs": runs,
        "columns": {"time": "t", "markers": {"centre": {"y": "y"}}},
    }))  # fmt: skip
    return read_tracks(folder)


@pytest.mark.slow
def test_a_drag_that_falls_at_a_critical_reynolds_number_is_named_and_measured(tmp_path):
    tracks = tracks_of_fast_balls(tmp_path)
    config = RefineConfig.model_validate({"effects": ["drag_crisis", "quadratic_drag", "linear_drag", "body_force"]})
    after = refine_group(tracks, "balls", SearchSettings.of(config)).search.after
    assert after.model.effects == ("drag_crisis",)
    true = {"drag_coefficient_below": BELOW, "drag_coefficient_above": ABOVE, "critical_reynolds_number": CRITICAL}
    for name, value in true.items():
        found, error = (part[f"drag_crisis.{name}"] for part in (after.values, after.stderr))
        assert abs(found - value) < 4 * error
        assert error < 0.1 * value
    assert after.validation_mm < 3 * NOISE * 1e3
