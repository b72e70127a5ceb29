"""Where the thresholds of masiv/calibration/consistency.py come from: random rings of cameras with known errors.

    python benchmarks/silhouette_consistency.py --draws 400

A random convex body moves before 3 to 11 cameras of 320 × 320 pixels on a ring. equal: the rotation [°], position and
focal length of every camera have random errors of one standard deviation, which is drawn from 0.01° to 0.5° (and as
many percent of a metre, and percent). one odd: these errors have 0.1°, and one camera is turned by another 1°. exact:
no error. Printed are quantiles of the largest ratio of a camera's error to that among the others, and of the error
[pixels] itself.
"""

from __future__ import annotations

import argparse
import dataclasses

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from masiv.calibration.consistency import RESOLUTION, pair_errors
from masiv.calibration.tangency import Outline, outline
from masiv.scene.camera import Camera
from masiv.scene.frame_cache import Frame

SIZE, FRAMES = 320, 6
CAMERAS = (3, 4, 5, 6, 8, 11)


def camera(rng: np.random.Generator, angle: float) -> Camera:
    height, distance = rng.uniform(0, 0.8), rng.uniform(2, 3)
    centre = distance * np.array([np.cos(angle) * np.cos(height), np.sin(height), np.sin(angle) * np.cos(height)])
    forward = 0.05 * rng.normal(size=3) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    focal = rng.uniform(1.2, 1.8) * SIZE
    return Camera(f"{angle:.2f}", SIZE, SIZE, np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]), pose)


def scene(rng: np.random.Generator, count: int) -> tuple[list[Camera], list[list[Outline | None]]]:
    cameras = [camera(rng, 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count) for k in range(count)]
    body = rng.normal(size=(40, 3))
    body *= rng.uniform(0.1, 0.3, 3) * rng.uniform(0.6, 1, (40, 1)) / np.linalg.norm(body, axis=1)[:, None]
    velocity, spin = 0.25 * rng.normal(size=3), rng.normal(size=3)
    outlines: list[list[Outline | None]] = [[] for _ in cameras]
    for time in np.arange(FRAMES) / FRAMES:
        points = body @ Rotation.from_rotvec(spin * time).as_matrix().T + velocity * (time - 0.5)
        for k, seen_by in enumerate(cameras):
            # OpenCV has pixel centres at whole numbers, and here 16 fractional bits.
            corners = cv2.convexHull(seen_by.project(points)[0].astype(np.float32))[:, 0] - 0.5
            mask = np.zeros((SIZE, SIZE), np.uint8)
            cv2.fillConvexPoly(mask, np.round(65536 * corners).astype(np.int32), 1, shift=16)
            valid = np.ones(mask.shape, bool)
            outlines[k].append(outline(Frame(np.zeros((1, 1, 3), np.uint8), mask.astype(np.float32), valid)))
    return cameras, outlines


def perturbed(rng: np.random.Generator, given: Camera, degrees: float) -> Camera:
    """Random errors: ``degrees`` of rotation, as many percent of a metre and of the focal length."""
    turned = turn(given, np.deg2rad(degrees) * rng.normal(size=3))
    turned.world_to_camera[:3, 3] += 0.01 * degrees * rng.normal(size=3)
    intrinsics = given.intrinsics * [[1], [1], [1]]
    intrinsics[[0, 1], [0, 1]] *= 1 + 0.01 * degrees * rng.normal()
    return dataclasses.replace(turned, intrinsics=intrinsics)


def turn(given: Camera, vector: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    return dataclasses.replace(given, world_to_camera=pose @ given.world_to_camera)


def largest_ratio(pairs: np.ndarray) -> tuple[float, int]:
    ratios = []
    for k in range(len(pairs)):
        rest = np.delete(np.arange(len(pairs)), k)
        mine = np.nanmedian(np.concatenate([pairs[k, rest], pairs[rest, k]]))
        ratios.append(mine / max(RESOLUTION, np.nanmedian(pairs[np.ix_(rest, rest)])))
    return max(ratios), int(np.argmax(ratios))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("cameras | exact: error [px] 50 %, 99 % | equal: ratio 50 %, 95 %, 99 % | one odd: ratio 5 %, 25 %, 50 %")
    for count in CAMERAS:
        exact, equal, odd = [], [], []
        for _ in range(arguments.draws):
            cameras, outlines = scene(rng, count)
            exact.append(np.nanmedian(pair_errors(cameras, outlines)))
            degrees = np.exp(rng.uniform(np.log(0.01), np.log(0.5)))
            rough = [perturbed(rng, given, degrees) for given in cameras]
            equal.append(largest_ratio(pair_errors(rough, outlines))[0])
            rough, turned = [perturbed(rng, given, 0.1) for given in cameras], int(rng.integers(count))
            axis = np.append(rng.normal(size=2), 0.0)
            rough[turned] = turn(rough[turned], np.deg2rad(1.0) * axis / np.linalg.norm(axis))
            ratio, found = largest_ratio(pair_errors(rough, outlines))
            odd.append(ratio if found == turned else 0.0)
        columns = ((exact, (0.5, 0.99)), (equal, (0.5, 0.95, 0.99)), (odd, (0.05, 0.25, 0.5)))
        print(count, *("| " + " ".join(f"{q:.2f}" for q in np.quantile(of, at)) for of, at in columns), flush=True)


if __name__ == "__main__":
    main()
