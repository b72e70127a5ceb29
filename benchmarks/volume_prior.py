"""The prior of the volume against the true one, with given masks.

usage: python benchmarks/volume_prior.py SCENE … [--frames 12]

SCENE: PAC-NeRF's layout with 11 cameras, masks and gt/particles_0.npy. Prints, for all cameras and for every second of
the first eight, the median over the true volume, and its distance from that in standard deviations.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.trajectory import known_volume
from masiv.observations.read import read_scene

RESOLUTION = 56
"""Voxels along the hull, as in the preset ``quick``."""


def true_volume(particles: np.ndarray) -> float:
    """Of a body that ``particles`` (N, 3) [m] fill [m³]: dilated by two spacings, then eroded by one and a half."""
    tree = cKDTree(particles)
    spacing = 1.1 * float(np.median(tree.query(particles, k=2)[0][:, 1]))
    low, voxel = particles.min(axis=0) - 4 * spacing, spacing / 3
    counts = np.ceil((particles.max(axis=0) + 4 * spacing - low) / voxel).astype(int)
    centres = low + voxel * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3) + 0.5)
    solid = (tree.query(centres, distance_upper_bound=2 * spacing)[0] < 2 * spacing).reshape(counts)
    return float((ndimage.distance_transform_edt(solid) * voxel > 1.5 * spacing).sum()) * voxel**3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=12)
    given = parser.parse_args()
    config = TrajectoryConfig(fill_resolution=RESOLUTION)
    for path in given.scenes:
        volume = true_volume(np.load(path / "gt" / "particles_0.npy"))
        scene = read_scene(path)
        for views in (scene.views, scene.views[:8:2]):
            hidden = tuple(view for view in scene.views if view not in views)
            prior = known_volume(scene.restricted(given.frames, hidden), config)
            if prior is not None:
                ratio, sd = prior.volume / volume, prior.log_sd
                print(f"{path.name}, {len(views)} cameras: {ratio:.2f}, {np.log(ratio) / sd:+.1f}", flush=True)


if __name__ == "__main__":
    main()
