"""Tracks -> missing physics: a ball falls through air, and refine measures the drag that nobody declared.

    python examples/free_fall_with_drag.py [FOLDER]          (a few seconds)

The data are the closed form y(t) = h - ln cosh(t sqrt(g k)) / k with 1 mm of noise."""

import sys
from pathlib import Path

import numpy as np
import yaml

import masiv

G, K = 9.81, 0.12  # gravity [m/s^2], drag over mass [1/m]


def main(folder: Path) -> dict:
    rng, rows, runs = np.random.default_rng(0), ["drop,t,height"], []
    for drop, height in enumerate((6.0, 7.0, 8.0, 9.0)):
        times = np.arange(0, 1.0, 1 / 60)
        y = height - np.log(np.cosh(times * np.sqrt(G * K))) / K + rng.normal(0, 1e-3, len(times))
        rows += [f"{drop},{t:.6f},{value:.9f}" for t, value in zip(times, y, strict=True)]
        use = "hold_out" if drop == 3 else "fit"
        runs.append({"file": "drops.csv", "body": "ball", "select": {"drop": drop}, "use": use})
    geometry = {"sphere": 0.04, "units": "m", "markers_at": {"centre": [0, 0, 0]}}
    scene = {"layout": "tracks", "units": "m", "up_axis": "y", "gravity": G, "runs": runs,
             "columns": {"time": "t", "markers": {"centre": {"y": "height"}}},
             "bodies": {"ball": {"group": "balls", "mass": 0.003, "geometry": geometry}}}  # fmt: skip
    (folder / "scene").mkdir(parents=True, exist_ok=True)
    (folder / "scene/drops.csv").write_text("\n".join(rows) + "\n")
    (folder / "scene/scene.yaml").write_text(yaml.safe_dump(scene))
    run = masiv.open_run(folder / "scene", folder / "run")
    run.identify()
    return run.refine(masiv.RefineRequest(group=True)).data


if __name__ == "__main__":
    result = main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/free_fall"))
    print(result["verdict"], result["accepted"][0]["theta"], "±", result["accepted"][0]["stderr"])
