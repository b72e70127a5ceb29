"""What ``masiv inspect`` says of recordings with a known fault, and of recordings without one.

    python benchmarks/inspect_faults.py SCENE … --faults     # a row a scene; with --faults, a row a fault

A fault is put into the scene as it is read: nothing is written but the table. ``--faults`` takes every other camera of
the scene. Columns: the fault, whether a problem names it (camera and frames, too), what the problem says, how many
other problems there are, and the time of one core [s].
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from masiv.observations.read import read_observation
from masiv.report.inspection import inspection
from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Ground, Scene

LATE, BAD_FRAME = 2, 5  # view and frame that are made wrong


def late(scene: Scene, frames: int) -> Scene:
    return dataclasses.replace(
        scene,
        frame_count=scene.frame_count - frames,
        load=lambda view, frame: scene.load(view, frame + frames * (view == LATE)),
    )


def half_a_frame_late(scene: Scene) -> Scene:
    """Every other frame, of one camera the frames between."""
    return dataclasses.replace(
        scene,
        fps=scene.fps / 2,
        frame_count=scene.frame_count // 2,
        load=lambda view, frame: scene.load(view, 2 * frame + (view == LATE)),
    )


def every_other_frame(scene: Scene) -> Scene:
    return dataclasses.replace(
        scene,
        fps=scene.fps / 2,
        frame_count=scene.frame_count // 2,
        load=lambda view, frame: scene.load(view, 2 * frame),
    )


def with_mask(scene: Scene, change: Callable[[np.ndarray], np.ndarray]) -> Scene:
    def load(view: int, frame: int) -> Frame:
        picture = scene.load(view, frame)
        if (view, frame) != (LATE, BAD_FRAME):
            return picture
        return dataclasses.replace(picture, mask=change(picture.mask.copy()))

    return dataclasses.replace(scene, load=load)


def cut(mask: np.ndarray) -> np.ndarray:
    """The upper quarter is missing."""
    rows = np.flatnonzero((mask > 0.5).any(axis=1))
    mask[: rows[len(rows) // 4]] = 0
    return mask


def grown(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask, np.ones((5, 5), np.float32))


def holed(mask: np.ndarray) -> np.ndarray:
    """A hole of 5 % where the mask is thickest."""
    depth = cv2.distanceTransform((mask > 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    radius = round(float(np.sqrt(0.05 * (mask > 0.5).sum() / np.pi)))
    return cv2.circle(mask, (int(column), int(row)), radius, 0.0, cv2.FILLED)


def turned(scene: Scene, degrees: float) -> Scene:
    cameras = list(scene.cameras)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.8, 0])).as_matrix()
    cameras[LATE] = dataclasses.replace(cameras[LATE], world_to_camera=pose @ cameras[LATE].world_to_camera)
    return dataclasses.replace(scene, cameras=tuple(cameras))


def wrong_up(scene: Scene) -> Scene:
    up = np.roll(scene.up, 1)
    return dataclasses.replace(scene, up=up, gravity=-9.8 * up, ground=Ground(up, -0.5))


NAMED = f"view {LATE} "
FAULTS: dict[str, tuple[Callable[[Scene], Scene], str | None]] = {
    "none": (lambda scene: scene, None),
    "none, every other frame": (every_other_frame, None),
    "view 2 late by 2 frames": (lambda scene: late(scene, 2), NAMED + r".*later than"),
    "view 2 late by 0.5 frames": (half_a_frame_late, NAMED + r".*later than"),
    "view 2 turned by 2°": (lambda scene: turned(scene, 2.0), NAMED + ".*silhouettes disagree"),
    "mask 2:5 empty": (lambda scene: with_mask(scene, np.zeros_like), "view 2 at frame 5: the mask is empty"),
    "mask 2:5 without its upper quarter": (lambda scene: with_mask(scene, cut), NAMED + r".*flickers at frame 5 "),
    "mask 2:5 grown by 2 px": (lambda scene: with_mask(scene, grown), NAMED + r".*flickers at frame 5 "),
    "mask 2:5 with a hole of 5 %": (lambda scene: with_mask(scene, holed), NAMED + r".*flickers at frame 5 "),
    "up axis z, y is true": (wrong_up, "falls by .*correct up_axis"),
    "fps twice the true": (lambda scene: dataclasses.replace(scene, fps=2 * scene.fps), "accelerates by .*check fps"),
}


def row(scene: Scene, fault: str) -> str:
    change, expected = FAULTS[fault]
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        summary, _ = inspection(change(scene), Path(folder) / "sheet.png")
    problems = [problem for problem in summary["problems"] if problem not in scene.problems]
    hits = [problem for problem in problems if expected is not None and re.search(expected, problem)]
    others = [problem for problem in problems if problem not in hits]
    found = "" if expected is None else "yes" if hits else "**no**"
    say = re.split(": (?:correct|check|synchronise)", re.sub(r"^view \d+ \([^)]*\): ", "", "; ".join(hits)))[0]
    verdicts = " ".join(
        f"{name[:5]} {answer['verdict']}"
        for name, answer in summary["identifiability"][0].items()
        if isinstance(answer, dict)
    )
    extra = f"{len(others)}" + (f" ({'; '.join(others)})" if others else "")
    seconds = time.process_time() - begun
    return (
        f"| {scene.path.name} | {len(scene.views)} | {fault} | {found} | {say} | {extra} | {verdicts} | {seconds:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--faults", action="store_true")
    arguments = parser.parse_args()
    print("| scene | cameras | fault | found | what is said | other problems | will tell | core s |\n|" + "---|" * 8)
    for path in arguments.scenes:
        scene = read_observation(path)
        assert isinstance(scene, Scene)
        if arguments.faults:
            scene = dataclasses.replace(scene, hidden_views=tuple(range(1, len(scene.cameras), 2)))
        for fault in FAULTS if arguments.faults else ["none"]:
            print(row(scene, fault), flush=True)


if __name__ == "__main__":
    main()
