"""What a command waits for before it works: import, the first kernel, and the compilation of all that `identify` needs.

usage: python benchmarks/start_up.py

Seconds, the median of three. *warm*: Taichi's offline cache is filled. *upgraded*: warm, with the package in another
folder than the one that filled the cache. `identify`: of a small scene with few iterations, with an empty cache and
again with the filled one; the difference is compilation.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
FIRST = """
import time
began = time.perf_counter()
import torch
from masiv import runtime
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator
imported = time.perf_counter()
runtime.start("cpu")
x = 0.5 * torch.rand(1000, 3) + 0.1
simulator = Simulator(particle_count=1000, spacing=0.09, substep=2e-4, volume=0.125, density=1e3, gravity=(0, -9.8, 0))
law = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.3)
simulator.run(at_rest(x, torch.zeros(1000, 3), torch.zeros(1000, 3, 3)), law, 1, [1])
print(imported - began, time.perf_counter() - imported)
"""
SPEC = {
    "shape": {"kind": "cube", "size": 0.4}, "cameras": {"count": 4, "size": 64, "target": [0.0, 0.3, 0.0]},
    "velocity": [0.2, 0.0, 0.0], "frames": 5, "truth_particles": 512,
}  # fmt: skip
FEW = ("reconstruct.iterations=60", "trajectory.iterations=3", "identify.iterations=2", "identify.processes=1")


def first_kernel(cache: Path, package: Path) -> tuple[float, float]:
    """Seconds of the imports, and from there to the end of the first substep."""
    variables = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(cache), "PYTHONPATH": str(package)}
    done = subprocess.run(
        [sys.executable, "-c", FIRST], env=variables, cwd=cache.parent, capture_output=True, text=True, check=True
    )
    imported, ran = done.stdout.strip().splitlines()[-1].split()
    return float(imported), float(ran)


def identify(cache: Path, scene: Path, run: Path) -> float:
    """Seconds of `masiv identify`."""
    settings = [part for one in FEW for part in ("--set", one)]
    command = [sys.executable, "-m", "masiv.cli.main", "identify", str(scene), "--out", str(run), "--preset", "quick"]
    began = time.perf_counter()
    subprocess.run(
        [*command, *settings], env={**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(cache)}, capture_output=True,
        check=True,
    )  # fmt: skip
    return time.perf_counter() - began


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        shutil.copytree(ROOT / "masiv", here / "other" / "masiv")
        print("| | import | first substep |\n|---|---|---|")
        cold = first_kernel(here / "cache", ROOT)
        print(f"| cold | {cold[0]:.2f} | {cold[1]:.2f} |")
        for name, package in (("warm", ROOT), ("warm, upgraded", here / "other")):
            times = [first_kernel(here / "cache", package) for _ in range(3)]
            imported, ran = (statistics.median(column) for column in zip(*times, strict=True))
            print(f"| {name} | {imported:.2f} | {ran:.2f} |")
        (here / "spec.yaml").write_text(yaml.safe_dump(SPEC))
        masiv = [sys.executable, "-m", "masiv.cli.main"]
        subprocess.run([*masiv, "synth", str(here / "spec.yaml"), "--out", str(here / "scene")], check=True)
        empty = identify(here / "identify_cache", here / "scene", here / "run1")
        filled = identify(here / "identify_cache", here / "scene", here / "run2")
        print(
            f"identify: {empty:.1f} s with an empty cache, {filled:.1f} with it filled: {empty - filled:.1f} s compiled"
        )


if __name__ == "__main__":
    main()
