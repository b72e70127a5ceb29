"""Peak memory of each stage, by what grows.

usage: python benchmarks/memory.py OUT [--cases NAME ...] [--table]

Each case is a scene that ``masiv synth`` makes (its pictures enlarged without detail where they are large), and
``masiv identify --preset quick`` of it with few iterations: they change the time, not the memory. A case ``draw-SEED``
has cameras, frames, pictures and settings drawn at random. OUT/NAME keeps scene and run; a case whose run is done is
not run again. Refine is not measured here.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from enlarge import enlarge

SPEC = {
    "shape": {"kind": "cross", "size": 0.6, "rotation_deg": [20, 35, 10], "position": [-0.1, 0.0], "clearance": 0.12},
    "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 6.0e4, "poissons_ratio": 0.3}},
    "velocity": [0.6, -0.6, 0.1],
    "omega": [0.5, 1.5, -2.0],
    "image_noise": 0.8,
    "texture": "noise",
    "truth_particles": 4096,
    "seed": 7,
}
FEW = ("reconstruct.iterations=60", "trajectory.iterations=12", "identify.iterations=2", "identify.family_rollouts=4")
Case = tuple[int, int, int, int, tuple[str, ...]]
"""Cameras, frames, side of the pictures, factor by which they are enlarged, settings."""
CASES: dict[str, Case] = {
    "small": (9, 12, 96, 1, ()),
    "pictures": (9, 12, 160, 6, ()),
    "cameras": (19, 12, 160, 6, ()),
    "frames": (9, 48, 160, 3, ()),
    "hulls": (9, 48, 96, 1, ("reconstruct.hull_resolution=128", "trajectory.fill_resolution=128")),
    "particles": (9, 12, 96, 1, ("trajectory.particle_count=20000",)),
    "one_process": (9, 12, 96, 1, ("reconstruct.processes=1", "identify.processes=1")),
    "gaussians": (9, 12, 160, 1, ("reconstruct.gaussians=20000", "reconstruct.crop_side=160")),
    "states": (9, 12, 96, 1, ("simulator.memory_mb=300",)),
    "classical": (9, 12, 96, 1, ("identify.law=neo_hookean",)),
}


MAX_PIXELS = 2e8
"""Of all pictures of a drawn case."""


def drawn(seed: int) -> Case:
    """A case at random: 4 to 20 cameras, 8 to 24 frames, 96 x 96 to 960 x 960 pixels, and what takes memory."""
    rng = np.random.default_rng(seed)
    cameras, frames, side = int(rng.integers(4, 21)), int(rng.integers(8, 25)), int(rng.choice([96, 128, 160]))
    factor = max(
        k for k in (1, 2, 3, 4, 6)[: rng.integers(1, 6)] if k == 1 or cameras * frames * (k * side) ** 2 < MAX_PIXELS
    )
    settings = {
        "reconstruct.processes": rng.integers(1, 3),
        "reconstruct.gaussians": round(10 ** rng.uniform(3, 4.3)),
        "reconstruct.hull_resolution": rng.choice([48, 64, 96]),
        "trajectory.fill_resolution": rng.choice([48, 64, 96]),
        "trajectory.particle_count": round(10 ** rng.uniform(3.2, 4.3)),
        "identify.processes": rng.integers(1, 3),
        "identify.law": rng.choice(["neural", "neural", "neo_hookean"]),
        "simulator.memory_mb": rng.choice([300, 700, 1500]),
    }
    return cameras, frames, side, factor, tuple(f"{key}={value}" for key, value in settings.items())


def case_of(name: str) -> Case:
    """One of CASES, or drawn."""
    return drawn(int(name.removeprefix("draw-"))) if name.startswith("draw-") else CASES[name]


def run(out: Path, name: str) -> None:
    """Make the scene of a case and identify it."""
    cameras, frames, side, factor, settings = case_of(name)
    folder = out / name
    if _done(folder):
        return
    folder.mkdir(parents=True, exist_ok=True)
    spec = {**SPEC, "frames": frames}
    spec["cameras"] = {"count": cameras, "size": side, "field_of_view_deg": 28, "target": [0.05, 0.3, 0.0]}
    (folder / "spec.yaml").write_text(yaml.safe_dump(spec))
    scene = folder / "scene"
    if not scene.exists():
        _masiv("synth", str(folder / "spec.yaml"), "--out", str(scene))
    if factor > 1:
        scene, small = folder / "enlarged", scene
        if not scene.exists():
            enlarge(small, scene, factor)
    options = [part for setting in (*FEW, *settings) for part in ("--set", setting)]
    _masiv("identify", str(scene), "--out", str(folder / "run"), "--preset", "quick", *options)


def table(out: Path, names: Sequence[str]) -> str:
    """Peak memory [MB] by case and stage; in brackets what was said before the stage."""
    rows = ["| case | " + " | ".join(STAGES) + " |", "|---" * (len(STAGES) + 1) + "|"]
    for name in names:
        if _done(out / name):
            stages = yaml.safe_load((out / name / "run" / "run.yaml").read_text())["stages"]
            cells = (f"{s['peak_memory_mb']} ({s.get('expected_memory_mb', '-')})" for s in map(stages.get, STAGES))
            rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


STAGES = ("reconstruct", "trajectory", "identify")


def _done(folder: Path) -> bool:
    record = folder / "run" / "run.yaml"
    return record.is_file() and yaml.safe_load(record.read_text())["stages"]["identify"]["state"] == "done"


def _masiv(*arguments: str) -> None:
    print("masiv", *arguments, flush=True)
    subprocess.run([sys.executable, "-m", "masiv.cli.main", *arguments], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cases", nargs="+", default=list(CASES), help="names of CASES, or draw-SEED")
    parser.add_argument("--table", action="store_true", help="of the runs that are there, instead of running")
    asked = parser.parse_args()
    if not asked.table:
        for name in asked.cases:
            run(asked.out, name)
    print(table(asked.out, asked.cases))


if __name__ == "__main__":
    main()
