"""Where the thresholds of clocks (``MIN_Z``) and flicker (``MAX_OUTLINE_RATIO``) come from: recordings without a fault.

    python benchmarks/inspect_calibration.py --draws 50

A random convex body spins, falls and bounces before 3 to 11 cameras of 320 × 320 pixels, for 8 to 16 frames. The
cameras have random errors of rotation, position and focal length, of a standard deviation between 0.01° and 0.5° (and
as many percent of a metre, and percent). Clocks and masks are right. Printed are quantiles (50, 95, 100 %) over the
recordings of the largest clock offset in standard errors, in frames and in pixels, and of the largest outline error
over the usual one, and how many recordings have a mask that is said to flicker.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.silhouette_consistency import SIZE, camera, perturbed
from masiv.calibration.clocks import clocks
from masiv.calibration.consistency import tangency_series
from masiv.calibration.mask_flicker import flicker
from masiv.calibration.tangency import Outline, outline
from masiv.scene.camera import Camera
from masiv.scene.frame_cache import Frame

CAMERAS = (3, 4, 6, 11)
FPS = 24.0


def recording(rng: np.random.Generator, count: int) -> tuple[list[Camera], list[list[Outline | None]]]:
    cameras = [camera(rng, 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count) for k in range(count)]
    body = rng.normal(size=(40, 3))
    body *= rng.uniform(0.1, 0.3, 3) * rng.uniform(0.6, 1, (40, 1)) / np.linalg.norm(body, axis=1)[:, None]
    velocity, spin = 0.5 * rng.normal(size=3), 2 * rng.normal(size=3)
    frames = int(rng.choice([8, 12, 16]))
    end = (frames - 1) / FPS
    outlines: list[list[Outline | None]] = [[] for _ in cameras]
    for time in np.arange(frames) / FPS:
        bounce = 2.5 * abs(time - 0.6 * end) - 4.9 * (time - 0.6 * end) ** 2
        points = body @ Rotation.from_rotvec(spin * time).as_matrix().T + velocity * (time - end / 2)
        points = points + np.array([0, bounce - 0.2, 0])
        for seen_by, row in zip(cameras, outlines, strict=True):
            # OpenCV has pixel centres at whole numbers, and here 16 fractional bits.
            corners = cv2.convexHull(seen_by.project(points)[0].astype(np.float32))[:, 0] - 0.5
            mask = np.zeros((SIZE, SIZE), np.uint8)
            cv2.fillConvexPoly(mask, np.round(65536 * corners).astype(np.int32), 1, shift=16)
            valid = np.ones(mask.shape, bool)
            row.append(outline(Frame(np.zeros((1, 1, 3), np.uint8), mask.astype(np.float32), valid)))
    return cameras, outlines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("| cameras | largest clock / standard error | frames | px | largest outline error / usual | flickers |")
    print("|---|---|---|---|---|---|")
    for count in CAMERAS:
        rows, said = [], 0
        for _ in range(arguments.draws):
            cameras, outlines = recording(rng, count)
            degrees = np.exp(rng.uniform(np.log(0.01), np.log(0.5)))
            rough = [perturbed(rng, given, degrees) for given in cameras]
            found = clocks(tuple(range(count)), rough, outlines, FPS)
            masks = flicker(
                tuple(range(count)), tangency_series(rough, outlines), np.full((count, len(outlines[0])), 0.0)
            )
            said += any(masks.frames)
            if found is not None:
                worst = int(np.abs(found.z).argmax())
                ratio = np.nanmax(masks.outline) / np.nanmedian(masks.outline)
                offset = np.abs(found.offsets).max() * FPS
                rows.append([abs(found.z[worst]), offset, found.moves_px[worst], ratio])
        quantiles = np.quantile(rows, (0.5, 0.95, 1), axis=0).T
        print(
            "|",
            count,
            *("| " + " ".join(f"{q:.2f}" for q in row) for row in quantiles),
            f"| {said} of {arguments.draws} |",
        )


if __name__ == "__main__":
    main()
