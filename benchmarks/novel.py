"""What was never filmed, as pictures: one row a variation of a twin, one column a moment.

    python benchmarks/novel.py RUN OTHER_RUN OUT.jpg [--frames 20] [--camera 0]

RUN and OTHER_RUN: what ``masiv identify`` left of two objects; the second one gives its material and its body.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

MOMENTS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
LABEL = 24
"""Height of a row's label [pixels]."""


def variations(other: Path) -> dict[str, list[str]]:
    """Options of ``masiv simulate``, by what they are called in the picture."""
    return {
        "as identified": [],
        "velocity 1.5, 2, 0 m/s": ["--velocity=1.5,2,0"],
        "spin 0, 0, 12 rad/s": ["--omega=0,0,12"],
        "gravity of the moon, 1.6 m/s2": ["--gravity=0,-1.6,0"],
        "500 N sideways for 0.1 s": ["--force=500,0,0", "--force-until=0.1"],
        "the other object's material": [f"--law={other}"],
        "half of either material": [f"--law={other}", "--blend=0.5"],
        "the other object's body": [f"--geometry={other}"],
    }


def row(run: Path, label: str, options: list[str], frames: int, camera: str) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of one variation side by side, under its label."""
    with tempfile.TemporaryDirectory() as folder:
        masiv = [sys.executable, "-c", "from masiv.cli.main import run; run()"]
        given = ["simulate", str(run), "--frames", str(frames), "--render", "--camera", camera, "--out", folder]
        subprocess.run([*masiv, *given, *options], check=True)
        paths = sorted(Path(folder, "views").rglob("*.png"))
        chosen = [cv2.imread(str(paths[round(m * (len(paths) - 1))])) for m in MOMENTS]
    strip = np.concatenate(chosen, axis=1)
    head = np.full((LABEL, strip.shape[1], 3), 255, np.uint8)
    cv2.putText(head, label, (4, LABEL - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([head, strip])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--camera", default="0")
    o = parser.parse_args()
    rows = [row(o.run, label, options, o.frames, o.camera) for label, options in variations(o.other).items()]
    cv2.imwrite(str(o.out), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
