"""What silhouettes alone say about cameras: scenes with ground truth, with cameras that are off.

    python benchmarks/silhouette_calibration.py SCENE … [--cameras 11 4] [--faults none calibration all degree]

SCENE: a folder in the PAC-NeRF layout with gt/particles_F.npy. Faults: those of `recordings.py`, of which `none` has
exact cameras and given masks; `degree`: given masks, and each camera is off by 1° about each axis, 13 mm along each
axis and 2 % in focal length (standard deviations). The first 12 frames are fitted. Prints the root mean square
displacement [px] of the true particles over cameras and frames, after the similarity transform of the world that fits
best, before and after the correction; its standard error as the fit says it; and the epipolar tangency error that
`masiv inspect` shows, before and after (median over the cameras).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from calibration import reprojection_errors, true_particles
from recordings import FAULTS, degrade
from scipy.spatial.transform import Rotation

from masiv.calibration.consistency import silhouette_consistency
from masiv.calibration.from_silhouettes import calibrate_from_silhouettes
from masiv.observations.read import read_scene
from masiv.scene.calibration import corrected_camera
from masiv.scene.camera import Camera
from masiv.splat.config import CalibrationConfig

FIT_FRAMES = 12


def off_by_a_degree(cameras: list[Camera], seed: int = 11) -> tuple[Camera, ...]:
    """Standard deviations: 1°, 13.3 mm, 2 %."""
    rng = np.random.default_rng(seed)
    made = []
    for camera in cameras:
        pose, intrinsics = camera.world_to_camera.copy(), camera.intrinsics.copy()
        pose[:3, :3] = Rotation.from_rotvec(np.radians(rng.normal(size=3))).as_matrix() @ pose[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + 0.0133 * rng.normal(size=3))
        intrinsics[:2, :2] *= 1 + 0.02 * rng.normal()
        made.append(replace(camera, intrinsics=intrinsics, world_to_camera=pose))
    return tuple(made)


def row(path: Path, count: int, faults: str) -> str:
    """One line of the table."""
    exact = list(read_scene(path).cameras)
    if count < len(exact):
        exact = exact[: count * (len(exact) // count) : len(exact) // count]  # as degrade chooses
    with tempfile.TemporaryDirectory() as folder:
        degrade(path, Path(folder), count, "none" if faults == "degree" else faults)
        scene = read_scene(Path(folder)).restricted(FIT_FRAMES)
        if faults == "degree":
            scene = replace(scene, cameras=off_by_a_degree(exact))
        for view in scene.views:
            for frame in range(FIT_FRAMES):
                scene.load(view, frame)  # masks are estimated here
        begun = time.perf_counter()
        fit = calibrate_from_silhouettes(scene, CalibrationConfig())
        seconds = time.perf_counter() - begun
        assert fit is not None
        after = [corrected_camera(c, r, fit.pivot) for c, r in zip(scene.cameras, fit.corrections, strict=True)]
        inspected = np.nanmedian(
            silhouette_consistency(replace(scene, cameras=tuple(after), correct_masks=None)).pixels
        )
    points = true_particles(path / "gt")
    errors = [reprojection_errors(exact, cameras, points)[1] for cameras in (scene.cameras, after)]
    before, now, expected = (np.sqrt(np.mean(np.square(e))) for e in (*errors, fit.standard_errors_px))
    numbers = f"{before:.3f} | {now:.3f} | {errors[1].max():.3f} | {expected:.3f}"
    return (
        f"| {path.name} | {count} | {faults} | {numbers} | {np.nanmedian(fit.inconsistency):.2f} → {inspected:.2f} "
        f"| {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--cameras", type=int, nargs="*", default=[11, 4])
    parser.add_argument(
        "--faults", choices=(*FAULTS, "degree"), nargs="*", default=["none", "calibration", "all", "degree"]
    )
    given = parser.parse_args()
    print("| scene | cameras | faults | before | after | worst camera after | standard error | inspect | s |")
    print("|" + "---|" * 9)
    for scene in given.scenes:
        for count in given.cameras:
            for faults in given.faults:
                print(row(scene, count, faults), flush=True)


if __name__ == "__main__":
    main()
