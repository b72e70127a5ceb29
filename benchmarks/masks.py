"""Intersection over union of estimated masks with the true ones: of each picture, and of the Gaussians.

usage: python benchmarks/masks.py RUN EXACT_SCENE [--views 0,3,6,9]

RUN: of a scene without masks, whose reconstruct stage is done. EXACT_SCENE: the same recording with masks. --views: its
cameras, in the order of those of RUN; all by default.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from masiv import runtime
from masiv.observations.kept_masks import with_kept_masks
from masiv.observations.read import read_scene
from masiv.pipeline.stages import load_gaussians
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene
from masiv.splat.rendered_masks import as_reconstructed


def overlaps(found: Scene, exact: Scene, views: list[int]) -> np.ndarray:
    """Of all pictures of ``found`` that show the object, (N, 2): intersection over union, and relative error of the
    area."""
    rows = []
    for frame in range(found.frame_count):
        for view, true_view in zip(found.views, views, strict=True):
            mask, true = (s.frame(v, frame).mask > 0.5 for s, v in ((found, view), (exact, true_view)))
            if true.any():
                rows.append(((mask & true).sum() / (mask | true).sum(), mask.sum() / true.sum() - 1))
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("exact", type=Path)
    parser.add_argument("--views", default="")
    given = parser.parse_args()
    run = RunFolder.open(given.run)
    scene = with_kept_masks(read_scene(run.scene_path), run.masks).restricted(run.fit_frames, run.holdout_cameras)
    exact = read_scene(given.exact)
    views = [int(v) for v in given.views.split(",")] if given.views else list(scene.views)
    runtime.start("cpu")
    for name, found in (("pictures", scene), ("Gaussians", as_reconstructed(scene, load_gaussians(run)))):
        rows = overlaps(found, exact, views)
        print(
            f"{name}: IoU mean {rows[:, 0].mean():.3f}, smallest {rows[:, 0].min():.3f}; area {rows[:, 1].mean():+.3f} "
            f"± {rows[:, 1].std():.3f}"
        )


if __name__ == "__main__":
    main()
