"""How time and memory grow: particles, length of a rollout, Gaussians, pixels, cameras, frames.

usage: python benchmarks/scale.py OUT [--axes particles backward length gaussians pixels cameras frames]
       python benchmarks/scale.py OUT --table

Each point is a process of its own: seconds of the work after a first, short pass that compiles its kernels, and the
peak of the process's memory (of the largest process, for stages). An exponent is the slope of a straight line through
the logarithms of the upper half of the points. A point whose line is in OUT/points.jsonl is not measured again. --table
also writes OUT/scale.webp.

particles: a neo-Hookean cube, forward; backward: with its adjoint; length: substeps of a rollout of 2000 particles with
its adjoint. gaussians, pixels: a picture and its gradient; 320 x 320 pixels, 10,000 Gaussians where these do not vary.
cameras, frames: `masiv reconstruct --preset quick` of a scene made by `masiv synth` with pictures of 96 x 96 pixels;
8 frames, 4 cameras where these do not vary.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import yaml

SIDE = 0.5
POINTS = {
    "particles": (1_000, 10_000, 100_000, 1_000_000),
    "backward": (1_000, 10_000, 100_000, 1_000_000),
    "length": (100, 400, 1_600, 6_400),
    "gaussians": (1_000, 10_000, 100_000),
    "pixels": (160**2, 320**2, 640**2, 1280 * 720, 1920 * 1080),
    "cameras": (4, 8, 16, 32),
    "frames": (12, 50, 200),
}
SIZES = {160**2: (160, 160), 320**2: (320, 320), 640**2: (640, 640), 1280 * 720: (1280, 720), 1920 * 1080: (1920, 1080)}
LABELS = {
    "particles": "particles, forward",
    "backward": "particles, forward and backward",
    "length": "substeps, forward and backward",
    "gaussians": "Gaussians, picture and gradient",
    "pixels": "pixels, picture and gradient",
    "cameras": "cameras, reconstruct",
    "frames": "frames, reconstruct",
}


def of_rollout(count: int, steps: int, *, backward: bool) -> float:
    """Seconds of a substep (``backward``: and of its adjoint) of ``count`` particles in a rollout of ``steps``."""
    import torch

    from masiv import runtime

    runtime.start("cpu")
    from masiv.materials.classical import ClassicalLaw
    from masiv.mpm.rollout import at_rest, rollout
    from masiv.mpm.simulator import Simulator

    law = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.3)
    simulator = Simulator(
        particle_count=count, spacing=(6 * SIDE**3 / count) ** (1 / 3), substep=1e-4 * min(1, (1e5 / count) ** (1 / 3)),
        volume=SIDE**3, density=1e3, gravity=(0, -9.8, 0), grid_nodes=max(1 << 18, count),
    )  # fmt: skip
    x = SIDE * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.1, 0.0])
    velocity = torch.tensor([0.0, -1.0, 0.0]).expand(count, 3)
    start = at_rest(x.requires_grad_(backward), velocity, torch.zeros(count, 3, 3))

    def once(number: int) -> float:
        began = time.perf_counter()
        with torch.set_grad_enabled(backward):
            end = rollout(simulator, law, start, number, [number])
        if backward:
            end.sum().backward()
        return time.perf_counter() - began

    once(2)
    return once(steps)


def of_picture(gaussians: int, width: int, height: int) -> float:
    """Seconds of a picture and of its gradient."""
    import torch

    from masiv import runtime

    runtime.start("cpu")
    from masiv.scene.camera import Camera
    from masiv.splat.rasteriser import render

    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[2, 3] = 2.0
    focal = 1.5 * height
    intrinsics = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    camera = Camera("one", width, height, intrinsics, pose)
    means = rng.uniform(-0.4, 0.4, (gaussians, 3))
    scales = 0.5 * 0.8 / gaussians ** (1 / 3) * rng.uniform(0.7, 1.3, gaussians)
    opacities, colours = rng.uniform(0.3, 1, gaussians), rng.uniform(0, 1, (gaussians, 3))
    given = [
        torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in (means, scales, opacities, colours)
    ]  # fmt: skip

    def once() -> float:
        began = time.perf_counter()
        picture = render(camera, *given, torch.tensor([0.2, 0.5, 0.9]))
        torch.autograd.grad(picture.rgb.sum() + picture.depth.sum(), given)
        return time.perf_counter() - began

    once()
    return float(np.median([once() for _ in range(3)]))


def of_stage(out: Path, cameras: int, frames: int) -> float:
    """Seconds of ``masiv reconstruct``."""
    masiv = [sys.executable, "-m", "masiv.cli.main"]
    case = out / f"{cameras}x{frames}"
    spec, scene = case / "spec.yaml", case / "scene"
    if not (scene / "all_data.json").is_file():
        case.mkdir(parents=True, exist_ok=True)
        spec.write_text(yaml.safe_dump({
            "shape": {"kind": "cross", "size": 0.6, "rotation_deg": [20, 35, 10], "clearance": 0.3},
            "velocity": [0.3, -0.2, 0.0], "cameras": {"count": cameras, "size": 96, "target": [0.1, 0.45, 0.0]},
            "frames": frames, "fps": 5 * frames, "seed": 1,
        }))  # fmt: skip
        subprocess.run([*masiv, "synth", str(spec), "--out", str(scene)], check=True, capture_output=True)
    began = time.perf_counter()
    run = case / "run"
    subprocess.run([*masiv, "reconstruct", str(scene), "--out", str(run), "--preset", "quick"], check=True)
    return time.perf_counter() - began


def measure(out: Path, axis: str, value: int) -> None:
    """Print a point as one line of JSON."""
    who = resource.RUSAGE_SELF
    if axis in ("particles", "backward"):
        steps = 64 if value <= 100_000 else 16
        seconds = of_rollout(value, steps, backward=axis == "backward") / steps
    elif axis == "length":
        seconds = of_rollout(2_000, value, backward=True)
    elif axis == "gaussians":
        seconds = of_picture(value, 320, 320)
    elif axis == "pixels":
        seconds = of_picture(10_000, *SIZES[value])
    else:
        seconds = of_stage(out, value if axis == "cameras" else 4, value if axis == "frames" else 8)
        who = resource.RUSAGE_CHILDREN
    peak = resource.getrusage(who).ru_maxrss / 1024
    print(json.dumps({"axis": axis, "value": value, "seconds": seconds, "peak_mb": peak}), flush=True)


def exponent(values: list[float], numbers: list[float]) -> float:
    """Slope of the logarithms of the upper half of the points."""
    half = len(values) // 2 - (len(values) > 3)
    return float(np.polyfit(np.log(values[half:]), np.log(numbers[half:]), 1)[0])


def table(out: Path) -> str:
    """Markdown of all points; writes OUT/scale.webp."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    points = [json.loads(line) for line in (out / "points.jsonl").read_text().splitlines()]
    axes = [axis for axis in POINTS if any(p["axis"] == axis for p in points)]
    lines = ["| what grows | values | seconds | exponent | peak memory [MB] | exponent |", "|" + "---|" * 6]
    figure, plots = pyplot.subplots(2, math.ceil(len(axes) / 2), figsize=(11, 5), constrained_layout=True)
    for axis, plot in zip(axes, plots.flat, strict=False):
        own = sorted((p for p in points if p["axis"] == axis), key=lambda p: p["value"])
        values, seconds, peaks = ([p[k] for p in own] for k in ("value", "seconds", "peak_mb"))
        slopes = [exponent(values, numbers) for numbers in (seconds, peaks)]
        cells = [", ".join(f"{n:.3g}" for n in numbers) for numbers in (seconds, peaks)]
        listed = ", ".join(f"{v:,}" for v in values)
        lines.append(f"| {LABELS[axis]} | {listed} | {cells[0]} | {slopes[0]:.2f} | {cells[1]} | {slopes[1]:.2f} |")
        plot.loglog(values, seconds, "o-", color="C0")
        plot.set_title(f"{LABELS[axis]}: {slopes[0]:.2f}", fontsize=8)
        plot.set_ylabel("s", color="C0")
        memory = plot.twinx()
        memory.semilogx(values, peaks, "s--", color="C1")
        memory.set_ylim(0, 1.1 * max(peaks))
        memory.set_ylabel("MB", color="C1")
    for plot in plots.flat[len(axes) :]:
        plot.set_visible(False)
    figure.savefig(out / "scale.webp", dpi=80)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--axes", nargs="*", choices=list(POINTS), default=list(POINTS))
    parser.add_argument("--point", nargs=2, metavar=("AXIS", "VALUE"), help=argparse.SUPPRESS)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if given.point:
        measure(given.out, given.point[0], int(given.point[1]))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "points.jsonl"
    known = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    for axis in [] if given.table else given.axes:
        for value in POINTS[axis]:
            if any(p["axis"] == axis and p["value"] == value for p in known):
                continue
            done = subprocess.run(
                [sys.executable, __file__, str(given.out), "--point", axis, str(value)], capture_output=True, text=True
            )
            if done.returncode:
                print(f"{axis} {value}: {done.stderr.strip().splitlines()[-1]}", flush=True)
                continue
            line = done.stdout.strip().splitlines()[-1]
            print(line, flush=True)
            with path.open("a") as file:
                file.write(line + "\n")
    if given.table:
        print(table(given.out))


if __name__ == "__main__":
    main()
