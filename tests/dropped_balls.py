"""Balls dropped in air, with exact heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import yaml

from masiv.tracks.read import read_tracks

G, AIR = 9.8, 1.2


@dataclass(frozen=True)
class Ball:
    mass: float
    diameter: float
    drag: float

    @property
    def rate(self) -> float:
        """k of a = -k v^2 [1/m]."""
        return AIR * self.drag * np.pi * self.diameter**2 / (8 * self.mass)

    def fallen(self, t: np.ndarray, speed: float) -> np.ndarray:
        """Way down [m], begun at ``speed`` [m/s] downwards, below the terminal velocity."""
        if self.rate == 0:
            return speed * t + 0.5 * G * t**2
        end = np.sqrt(G / self.rate)
        phase = np.arctanh(speed / end)
        return end**2 / G * (np.log(np.cosh(G * t / end + phase)) - np.log(np.cosh(phase)))


def write_scene(folder, balls, noise=0.01, runs=(1, 2)):
    random = np.random.default_rng(3)
    rows, declared, files = ["ball,drop,t,height"], {}, []
    for name, ball in balls.items():
        declared[name] = {
            "mass": ball.mass, "group": "balls",
            "geometry": {"sphere": ball.diameter, "units": "m", "markers_at": {"centre": [0, 0, 0]}},
        }  # fmt: skip
        for drop in runs:
            t = np.arange(0, 2.6, 1 / 15)
            heights = 40 + drop - ball.fallen(t, 0.3 * drop) + random.normal(0, noise, len(t))
            rows += [f"{name},{drop},{a:.9f},{b:.12f}" for a, b in zip(t, heights, strict=True)]
            files.append({"file": "drops.csv", "body": name, "select": {"ball": name, "drop": drop},
                          "use": "fit" if drop == 1 else "hold_out"})  # fmt: skip
    (folder / "drops.csv").write_text("\n".join(rows))
    (folder / "scene.yaml").write_text(yaml.safe_dump({
        "layout": "tracks", "units": "m", "up_axis": "y", "bodies": declared, "runs": files,
        "columns": {"time": "t", "markers": {"centre": {"y": "height"}}},
    }))  # fmt: skip
    return read_tracks(folder)
