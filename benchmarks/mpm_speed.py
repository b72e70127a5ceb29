"""Speed of the simulator: million particle-substeps a second, forward and forward + backward, and that of plain Taichi
autodiff.

    python benchmarks/mpm_speed.py [--arch cpu] [--particles 1000,5000] [--laws "neo_hookean;neural"]

Cold compile is timed in new processes with Taichi's offline cache switched to an empty folder, warm with that folder
filled. Peak memory is the process's high-water mark. Each row is the median of repeats in one process; compare rows of
one run.
"""

import argparse
import datetime
import functools
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time

SIDE, DT = 0.5, 2e-4
DRAG = "neo_hookean, linear drag"


def substeps(count):
    """Of a rollout: fewer of many particles, so that all states fit into memory."""
    return 100 if count <= 50_000 else 20


def body(count):
    import torch

    generator = torch.Generator().manual_seed(0)
    x = SIDE * torch.rand(count, 3, generator=generator)
    x[:, 1] += 0.1
    return x


def time_masiv(law_name, count, repeats, arch):
    import torch

    torch.set_num_threads(1)
    from masiv import runtime

    began = time.perf_counter()
    runtime.start(arch)
    from masiv.materials.classical import ClassicalLaw
    from masiv.materials.load import load_law
    from masiv.mpm.rollout import at_rest, rollout
    from masiv.mpm.simulator import Simulator
    from masiv.pretraining.pretrain import pretrained_path

    effects = None
    law = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.3)
    if law_name == "neural":
        law = load_law(pretrained_path("jelly"))
    spacing, steps = (6 * SIDE**3 / count) ** (1 / 3), substeps(count)
    simulator = Simulator(particle_count=count, spacing=spacing, substep=DT, volume=SIDE**3, density=1e3,
                          gravity=(0, -9.8, 0), max_substeps=steps, memory_mb=8000,
                          grid_nodes=max(1 << 18, count))  # fmt: skip
    x = body(count).requires_grad_()
    if law_name == DRAG:
        from masiv.effects.active import ActiveEffects
        from masiv.effects.catalogue import effect_named
        from masiv.effects.context import EffectContext

        gravity = torch.tensor([0.0, -9.8, 0.0])
        context = EffectContext(gravity, x.detach(), 1e3 * SIDE**3 / count, SIDE, steps * DT, DT)
        effects = ActiveEffects(((effect_named("linear_drag"), torch.tensor([0.5])),), context)
    velocity = torch.tensor([0.0, -1.0, 0.0]).expand(count, 3)
    still = torch.zeros(count, 3, 3)
    rollout(simulator, law, at_rest(x, velocity, still), 1, [1], effects).sum().backward()
    first = time.perf_counter() - began
    forward, both = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        end = rollout(simulator, law, at_rest(x, velocity, still), steps, [steps], effects)
        middle = time.perf_counter()
        end.square().sum().backward()
        forward.append(middle - start)
        both.append(time.perf_counter() - start)
    return first, forward, both


def time_plain(count, repeats, arch):
    from masiv import runtime

    began = time.perf_counter()
    ti = runtime.start(arch)
    ti.lang.impl.current_cfg().cfg_optimization = True  # as Taichi has it, whose derivatives need it
    sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
    from mpm_plain import PlainMpm

    spacing = (6 * SIDE**3 / count) ** (1 / 3)
    x = body(count).numpy() + 4 * spacing
    cells = int((SIDE + 0.1) / spacing) + 12
    steps = 100 if count < 20000 else 20
    sim = PlainMpm(count, steps, cells, spacing, DT, 1e3 * SIDE**3 / count, SIDE**3 / count, 38462.0, 57692.0)

    @ti.kernel
    def fill(points: ti.types.ndarray()):
        for p in range(count):
            sim.x[0, p] = ti.Vector([points[p, 0], points[p, 1], points[p, 2]])
            sim.v[0, p] = ti.Vector([0.0, -1.0, 0.0])
            sim.c[0, p] = ti.Matrix.zero(ti.f32, 3, 3)
            sim.f[0, p] = ti.Matrix.identity(ti.f32, 3)

    fill(x)
    sim.forward()
    sim.backward()
    first = time.perf_counter() - began
    forward, both = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        sim.forward()
        ti.sync()  # launches on a GPU return before they end
        middle = time.perf_counter()
        sim.backward()
        ti.sync()
        scale = substeps(count) / steps
        forward.append((middle - start) * scale)
        both.append((time.perf_counter() - start) * scale)
    return first, forward, both


def use_cache(folder):
    """Taichi takes the folder of its kernel cache from ti.init alone."""
    os.environ["ENABLE_TAICHI_HEADER_PRINT"] = "False"
    import taichi as ti

    ti.init = functools.partial(ti.init, offline_cache_file_path=folder)


def worker(kind, count, repeats, arch):
    use_cache(os.environ["KERNEL_CACHE"])
    first, forward, both = (
        time_plain(count, repeats, arch) if kind == "plain" else time_masiv(kind, count, repeats, arch)
    )
    rate = 1e-6 * count * substeps(count)
    spread = (max(forward) - min(forward)) / statistics.median(forward)
    print(json.dumps({
        "kind": kind,
        "count": count,
        "first_s": first,
        "forward": rate / statistics.median(forward),
        "both": rate / statistics.median(both),
        "spread": spread,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }))  # fmt: skip
    import taichi as ti

    ti.reset()  # writes the kernel cache


def measure(kind, count, repeats, arch, cache):
    command = [sys.executable, __file__, "--worker", kind, str(count), str(repeats), "--arch", arch]
    environment = {**os.environ, "KERNEL_CACHE": cache}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--particles", default="1000,1500,5000,50000")
    parser.add_argument("--laws", default=f"neo_hookean;{DRAG};neural;plain", help="separated by ;")
    parser.add_argument("--worker", nargs=3)
    options = parser.parse_args()
    if options.worker:
        kind, count, repeats = options.worker
        worker(kind, int(count), int(repeats), options.arch)
        return
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    print("# Speed of the simulator\n")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, `--arch {options.arch}`, float32, 100 substeps"
    print(f"{datetime.date.today()}, commit {commit}, {machine}.\n`python benchmarks/mpm_speed.py`\n")
    print("Million particle-substeps a second: median of repeats, and the spread of the forward pass. First call: from")
    print("starting Taichi to the first gradient, with an empty and with a filled kernel cache.\n")
    print("| law | particles | forward | forward + backward | spread | first call, cold | warm | peak memory |")
    print("|---|---|---|---|---|---|---|---|")
    for count in map(int, options.particles.split(",")):
        for kind in options.laws.split(";"):
            repeats = 9 if count < 20000 else 3
            with tempfile.TemporaryDirectory() as cache:
                cold = measure(kind, count, 1, options.arch, cache)
                warm = measure(kind, count, repeats, options.arch, cache)
            name = {"plain": "neo_hookean, plain Taichi: atomics, `kernel.grad()`"}.get(kind, kind)
            speeds = f"{warm['forward']:.2f} | {warm['both']:.2f} | {100 * warm['spread']:.0f} %"
            costs = f"{cold['first_s']:.1f} s | {warm['first_s']:.1f} s | {warm['memory_mb']:.0f} MB"
            print(f"| {name} | {count:,} | {speeds} | {costs} |", flush=True)


if __name__ == "__main__":
    main()
