"""What a rough recording costs: scenes with ground truth, filmed worse.

usage: python benchmarks/recordings.py OUT --scenes SCENE … [--cameras 11 4] [--jobs 2]
                                       [--faults none calibration pictures all] [--law neural]
       python benchmarks/recordings.py OUT --table

SCENE: a folder in the PAC-NeRF layout with gt/particles_F.npy. Faults: `calibration`: each camera is off by 0.15° about
each axis, 2 mm along each axis and 0.3 % in focal length (standard deviations), no masks; `pictures`: noise of 4 grey
levels, JPEG of quality 60, no masks; `all`: both. `none` keeps the masks. Every case runs `masiv identify --preset
quick --fit-frames 12` and `masiv evaluate`. With several jobs each of them has one process.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FAULTS = ("none", "calibration", "pictures", "all")
ROWS = {
    "trajectory": "motion, trajectory, observed",
    "observed": "motion, twin, observed",
    "future": "motion, twin, future",
}


def degrade(scene: Path, out: Path, cameras: int, faults: str, seed: int = 7) -> None:
    """Write ``scene`` as a person would film it to ``out``: fewer cameras, evenly chosen, with ``faults``."""
    rng = np.random.default_rng(seed)
    listing = json.loads((scene / "all_data.json").read_text())
    names = [re.search(r"r_(\d+)_(-?\d+)\.png", row["file_path"]) for row in listing]
    views = sorted({int(name[1]) for name in names if name})
    step = len(views) // cameras
    chosen = views[: cameras * step : step] if cameras < len(views) else views
    errors = {view: _camera_error(rng) for view in chosen}
    (out / "data").mkdir(parents=True)
    kept = []
    for row, name in zip(listing, names, strict=True):
        if name is None or int(name[1]) not in chosen:
            continue
        view, frame = int(name[1]), int(name[2])
        target = f"r_{chosen.index(view)}_{frame}.png"
        picture = cv2.imread(str(scene / "data" / name[0]))
        if faults in ("pictures", "all"):
            picture = np.clip(picture + rng.normal(0, 4, picture.shape), 0, 255).astype(np.uint8)
            picture = cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_COLOR)
        cv2.imwrite(str(out / "data" / target), picture)
        mask = scene / "data" / f"m_{view}_{frame}.png"
        if faults == "none" and mask.is_file():
            shutil.copy(mask, out / "data" / f"m_{chosen.index(view)}_{frame}.png")
        pose, intrinsics = np.array(row["c2w"]), np.array(row["intrinsic"])
        if faults in ("calibration", "all"):
            rotation, shift, zoom = errors[view]
            pose[:3, :3] = pose[:3, :3] @ rotation
            pose[:3, 3] += shift
            intrinsics[:2, :2] *= zoom
        kept.append({**row, "file_path": f"./data/{target}", "c2w": pose.tolist(), "intrinsic": intrinsics.tolist()})
    (out / "all_data.json").write_text(json.dumps(kept))


def _camera_error(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    rotation = cv2.Rodrigues(rng.normal(0, np.radians(0.15), 3))[0]
    return rotation, rng.normal(0, 2e-3, 3), 1 + float(rng.normal(0, 0.003))


def run(scene: Path, out: Path, cameras: int, faults: str, law: str, processes: int) -> None:
    """Make the case, identify it and evaluate it; finished stages are kept. processes: of a job (0: all cores)."""
    case = out / f"{scene.name}.{cameras}.{faults}{'' if law == 'neural' else f'-{law}'}"
    data, folder = case / "scene", case / "run"
    if not (data / "all_data.json").is_file():
        shutil.rmtree(data, ignore_errors=True)
        degrade(scene, data, cameras, faults)
    masiv = [sys.executable, "-m", "masiv.cli.main"]
    config = case / "processes.yaml"
    config.write_text(f"reconstruct: {{processes: {processes}}}\nidentify: {{processes: {processes}}}\n")
    arguments = ["--out", str(folder), "--preset", "quick", "--fit-frames", "12", "--law", law, "--config", str(config)]
    with (case / "log.txt").open("a") as log:
        for command in (["identify", str(data), *arguments], ["evaluate", str(folder), "--truth", str(scene / "gt")]):
            done = subprocess.run([*masiv, *command], stdout=log, stderr=subprocess.STDOUT)
            print(f"{case.name}: masiv {command[0]} ended with {done.returncode}", flush=True)
            if done.returncode:
                return


def table(out: Path) -> str:
    """Markdown of all finished cases."""
    lines = ["| scene | cameras | faults | trajectory | twin, observed | twin, future | volume |", "|" + "---|" * 7]
    for case in sorted(out.glob("*.*.*")):
        evaluation = case / "run" / "evaluate.json"
        if not evaluation.is_file():
            continue
        scene, cameras, faults = case.name.rsplit(".", 2)
        numbers = json.loads(evaluation.read_text())
        volume = json.loads((case / "run" / "metrics.json").read_text())["trajectory"]
        cells = [_cell(numbers, row) for row in ROWS.values()]
        error = volume.get("volume_standard_error_m3", float("nan"))
        litres = f"{1e3 * volume['volume_m3']:.1f} ± {1e3 * error:.1f} l"
        lines.append(f"| {scene} | {cameras} | {faults} | {' | '.join(cells)} | {litres} |")
    return "\n".join(lines)


def _cell(numbers: dict[str, Any], row: str) -> str:
    kind, source, part = row.split(", ")
    found = numbers.get(kind, {}).get(source, {}).get(part)
    return "–" if found is None else f"{found['tracked_error_mm']:.1f} mm / {found['chamfer_1e3mm2']:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--cameras", type=int, nargs="*", default=[11, 4])
    parser.add_argument("--faults", choices=FAULTS, nargs="*", default=list(FAULTS))
    parser.add_argument("--law", default="neural")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    cases = [(s, given.out, c, f, given.law) for s in given.scenes for c in given.cameras for f in given.faults]
    processes = 1 if given.jobs > 1 else 0
    with ThreadPoolExecutor(given.jobs) as pool:
        for _ in pool.map(lambda case: run(*case, processes), cases):
            pass
    if given.table:
        print(table(given.out))


if __name__ == "__main__":
    main()
