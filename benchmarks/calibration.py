"""How far refined cameras are from the exact ones, as the pixels by which they displace the true particles.

    masiv reconstruct DEGRADED --out RUN --preset quick
    python benchmarks/calibration.py RUN EXACT_SCENE [RUN EXACT_SCENE ...] [--views 0,3,6,9]

RUN is of a scene whose cameras were perturbed; EXACT_SCENE has the exact cameras and gt/particles_F.npy. --views:
cameras of EXACT_SCENE that DEGRADED has, in its order (all by default). Prints a row a run: root mean square over
cameras, frames and particles of the displacement [px] before and after refinement; "aligned" is after the similarity
transform of the world (7 parameters, which no picture can determine) that fits best.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from masiv.observations.read import read_scene
from masiv.scene.calibration import Calibration
from masiv.scene.camera import Camera


def true_particles(folder: Path, per_frame: int = 300) -> np.ndarray:
    """Some of the particles (P, 3) [m] of all frames."""
    frames = sorted(folder.glob("particles_*.npy"))
    rng = np.random.default_rng(0)
    every = [np.load(path) for path in frames]
    return np.concatenate([points[rng.permutation(len(points))[:per_frame]] for points in every])


def fitted_similarity(
    exact: Sequence[Camera], estimated: Sequence[Camera], points: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """The similarity transform of points (P, 3) [m] for which ``estimated`` see best what ``exact`` see."""
    true = [camera.project(points)[0] for camera in exact]
    centre = points.mean(axis=0)

    def moved(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        return centre + p[3:6] + np.exp(p[6]) * Rotation.from_rotvec(p[:3]).apply(at - centre)

    def residuals(p: np.ndarray) -> np.ndarray:
        at = moved(p, points)
        return np.stack([camera.project(at)[0] - t for camera, t in zip(estimated, true, strict=True)]).ravel()

    found = least_squares(residuals, np.zeros(7), method="lm").x
    return lambda at: moved(found, at)


def reprojection_errors(
    exact: Sequence[Camera], estimated: Sequence[Camera], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square displacement [px] (V,) of each camera, as it is and after the best similarity transform."""
    aligned = fitted_similarity(exact, estimated, points)(points)
    rows = []
    for at in (points, aligned):
        off = [e.project(at)[0] - c.project(points)[0] for e, c in zip(estimated, exact, strict=True)]
        rows.append(np.sqrt((np.stack(off) ** 2).sum(axis=2).mean(axis=1)))
    return rows[0], rows[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, metavar="RUN EXACT_SCENE")
    parser.add_argument("--views", type=lambda text: [int(view) for view in text.split(",")])
    given = parser.parse_args()
    if len(given.paths) % 2:
        parser.error("give pairs of RUN and EXACT_SCENE")
    print("| run | before | after | before, aligned | after, aligned | worst camera after, aligned |")
    print("|---|---|---|---|---|---|")
    for run, scene in zip(given.paths[::2], given.paths[1::2], strict=True):
        calibration = Calibration.load(run)
        if calibration is None:
            parser.error(f"{run} has no calibration.json: its cameras were kept as given")
        cameras = read_scene(scene).cameras
        exact = [cameras[view] for view in given.views or range(len(cameras))]
        points = true_particles(scene / "gt")
        before, after = (reprojection_errors(exact, c, points) for c in (calibration.given, calibration.refined))
        figures = [np.sqrt((e**2).mean()) for e in (before[0], after[0], before[1], after[1])]
        print(f"| {run.name} | " + " | ".join(f"{f:.3f}" for f in (*figures, after[1].max())) + " |")


if __name__ == "__main__":
    main()
