"""A scene whose pictures have FACTOR times the width and height: for time and memory of large recordings.

usage: python benchmarks/enlarge.py SCENE OUT [--factor 9]

SCENE: a folder in PAC-NeRF's layout, as `masiv synth` makes it. Pictures are interpolated (bicubic), so they have many
pixels and no more detail. Intrinsics are scaled with them.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2


def enlarge(scene: Path, out: Path, factor: int) -> None:
    """Write the larger scene; what is no picture is copied."""
    shutil.copytree(scene, out, ignore=shutil.ignore_patterns("*.png", "gt"))
    for path in sorted((scene / "data").glob("*.png")):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        larger = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "data" / path.name), larger)
    views = json.loads((out / "all_data.json").read_text())
    for view in views:
        view["intrinsic"] = [[factor * value for value in row] for row in view["intrinsic"][:2]] + view["intrinsic"][2:]
    (out / "all_data.json").write_text(json.dumps(views))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--factor", type=int, default=9)
    given = parser.parse_args()
    enlarge(given.scene, given.out, given.factor)


if __name__ == "__main__":
    main()
