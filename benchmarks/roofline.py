"""Roofline of the simulator: what the machine can do, what a substep asks, and which part of it the laws reach.

    python benchmarks/roofline.py [--particles 5000] [--laws neo_hookean neural] [--threads 1 2]

Bandwidth: a triad a = b + s c of arrays that no cache holds. Peak: single-precision matrix products (NumPy's BLAS).
Operations and bytes a substep are counted by hand in
``OPERATIONS`` and ``traffic``. Each number of threads is a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import time

STATE_NUMBERS = 3 + 3 + 9 + 9 + 9 + 9
"""A substep writes so many of a particle (position, velocity, C, trial F, F, Kirchhoff stress), and reads them once."""
TRANSFER = 620 + 640
"""Floating-point operations of P2G and G2P of a particle: 27 nodes of 15, 9 lines of 13, weights and affine part 100;
9 lines of 53, 3 planes of 17, velocity gradient and F 110."""
NODE = 12
"""Of a node: sum of the chunks' momenta, division by the mass, gravity."""
OPERATIONS = {"neo_hookean": 110, "neural": 560}
"""Of a law; neural: two spectral invariants, two interpolations in tables, return mapping by a Cayley map."""


def bandwidth(threads):
    """[GB/s]"""
    import numpy as np
    import taichi as ti

    ti.init(arch=ti.cpu, cpu_max_num_threads=threads, log_level=ti.ERROR)
    count = 1 << 26
    a, b, c = (np.ones(count, np.float32) for _ in range(3))

    @ti.kernel
    def triad(a: ti.types.ndarray(), b: ti.types.ndarray(), c: ti.types.ndarray()):
        for i in a:
            a[i] = b[i] + 3.0 * c[i]

    return 3 * 4 * count / best(lambda: triad(a, b, c)) / 1e9


def peak(threads):
    """[Gflop/s]; BLAS takes its threads from the environment."""
    import numpy as np

    n = 2048
    a = np.random.default_rng(0).random((n, n), dtype=np.float32)
    return 2 * n**3 / best(lambda: a @ a) / 1e9


def best(run, repeats=5):
    """Shortest of some times [s]."""
    times = []
    run()
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def speed(law_name, count):
    """Particle-substeps a second of a rollout without derivatives, and nodes of its window a particle."""
    import torch
    from mpm_speed import DT, SIDE, body

    torch.set_num_threads(1)
    from masiv import runtime
    from masiv.materials.classical import ClassicalLaw
    from masiv.materials.load import load_law
    from masiv.mpm.rollout import at_rest
    from masiv.mpm.simulator import Simulator
    from masiv.pretraining.pretrain import pretrained_path

    runtime.start("cpu")
    law = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.3)
    if law_name == "neural":
        law = load_law(pretrained_path("jelly"))
    spacing = (6 * SIDE**3 / count) ** (1 / 3)
    simulator = Simulator(particle_count=count, spacing=spacing, substep=DT, volume=SIDE**3, density=1e3,
                          gravity=(0, -9.8, 0), max_substeps=100, memory_mb=8000, grid_nodes=1 << 18)  # fmt: skip
    x = body(count)
    state = at_rest(x, torch.tensor([0.0, -1.0, 0.0]).expand(count, 3), torch.zeros(count, 3, 3))
    with torch.no_grad():
        taken = best(lambda: simulator.run(state, law, 100, [], None, 0.0))
    nx, ny, nz = (int(v) for v in simulator.kernels.window_shape[None])
    return 100 * count / taken, nx * ny * nz / count


def traffic(nodes):
    """Bytes of a particle: its state written and read, and the grids of ``nodes`` a particle cleared, summed, logged
    and read; the stencils' own accesses stay in a cache."""
    return 4 * (2 * STATE_NUMBERS) + 16 * nodes * 5


def worker(what, threads, law, count):
    if what == "speed":
        return list(speed(law, count))
    return {"bandwidth": bandwidth, "peak": peak}[what](threads)


def in_process(what, threads, law="", count=0):
    cores = {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads),
             "TI_CPU_MAX_NUM_THREADS": str(threads)}  # fmt: skip
    command = [sys.executable, __file__, "--worker", what, str(threads), law, str(count)]
    out = subprocess.run(command, env={**os.environ, **cores}, capture_output=True, text=True, check=True)
    return json.loads(out.stdout.strip().splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, nargs="+", default=[1000, 5000, 50000])
    parser.add_argument("--laws", nargs="+", default=["neo_hookean", "neural"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--worker", nargs=4, metavar=("WHAT", "THREADS", "LAW", "COUNT"))
    args = parser.parse_args()
    if args.worker:
        what, threads, law, count = args.worker
        print(json.dumps(worker(what, int(threads), law, int(count))))
        return
    print("| threads | bandwidth [GB/s] | peak [Gflop/s] |\n|---|---|---|")
    machine = {}
    for threads in args.threads:
        machine[threads] = {what: in_process(what, threads) for what in ("bandwidth", "peak")}
        print(f"| {threads} | " + " | ".join(f"{v:.1f}" for v in machine[threads].values()) + " |")
    print(
        "\n| law | particles | threads | M particle-substeps/s | flop | bytes | Gflop/s | of the peak | GB/s "
        "| of the bandwidth |\n" + "|---" * 10 + "|"
    )
    for law in args.laws:
        for count in args.particles:
            for threads in args.threads:
                rate, nodes = in_process("speed", threads, law, count)
                flop, size, can = TRANSFER + OPERATIONS[law] + NODE * nodes, traffic(nodes), machine[threads]
                done, moved = 1e-9 * rate * flop, 1e-9 * rate * size
                print(
                    f"| {law} | {count:,} | {threads} | {1e-6 * rate:.2f} | {flop:.0f} | {size:.0f} | {done:.1f} | "
                    f"{done / can['peak']:.0%} | {moved:.1f} | "
                    f"{moved / can['bandwidth']:.0%} |"
                )


if __name__ == "__main__":
    main()
