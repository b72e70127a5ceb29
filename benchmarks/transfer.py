"""Does a less dissipative transfer than APIC's lose less of a swing? A clamped bar under gravity, let go from straight.

    python benchmarks/transfer.py [--cells 3 4] [--keep 0 0.9 1.0] [--courant 0.6]

A plain MLS-MPM in float64 numpy, apart from the simulator, whose transfer is APIC (keep 0). With keep a, a particle's
velocity is a (v + change of the grid's velocity) + (1 - a) (the grid's velocity); affine velocities and positions are
APIC's (AFLIP: Fei et al. 2021). Neo-Hookean bar of 30 x 30 x 100 mm, 264 kPa, Poisson's ratio 0.45, no viscosity.
Printed: frequency and decay of the tip's swing (``dissipation.swing``).
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time

import numpy as np
from dissipation import swing

LENGTH, THICKNESS, DENSITY, YOUNGS, POISSON = 0.1, 0.03, 1070.0, 264e3, 0.45
GRAVITY = np.array([-9.8, 0.0, 0.0])
OFFSETS = np.array(list(itertools.product(range(3), repeat=3)))


def kirchhoff(f: np.ndarray) -> np.ndarray:
    """mu (F F^T - 1) + lambda ln J 1 [Pa] of deformation gradients (N, 3, 3)."""
    mu = YOUNGS / (2 * (1 + POISSON))
    lam = YOUNGS * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    eye = np.eye(3)
    return mu * (f @ f.transpose(0, 2, 1) - eye) + lam * np.log(np.linalg.det(f))[:, None, None] * eye


def swung(cells: float, keep: float, courant: float, duration: float) -> tuple[np.ndarray, np.ndarray, dict]:
    """times (T,) [s], mean x (T,) [m] of the tip's particles, and what was simulated. Nodes at z <= 0 are held."""
    dx = THICKNESS / cells
    gap = dx / 2
    across = np.arange(gap / 2, THICKNESS, gap) - THICKNESS / 2
    along = np.arange(gap / 2, LENGTH + 2 * dx, gap) - 2 * dx  # two cells of it are in the clamp
    x = np.stack(np.meshgrid(across, across, along, indexing="ij"), -1).reshape(-1, 3)
    tip = x[:, 2] > LENGTH - 1.5 * gap
    volume = gap**3
    mass = DENSITY * volume
    sound = math.sqrt(YOUNGS * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON)) / DENSITY)
    dt = courant * dx / (sound + 0.5)
    v, c = np.zeros_like(x), np.zeros((len(x), 3, 3))
    f = np.tile(np.eye(3), (len(x), 1, 1))
    low = np.array([-6, -6, -4]) - int(THICKNESS / 2 / dx)
    shape = np.array([14, 14, 12]) + 2 * int(THICKNESS / dx) + np.array([0, 0, int(LENGTH / dx)])
    held = (np.arange(shape.prod()) % shape[2] + low[2]) * dx <= 0
    out = []
    for _ in range(int(duration / dt)):
        base = np.floor(x / dx - 0.5).astype(int)
        fx = x / dx - base
        w = np.stack([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2])
        weight = w[OFFSETS[:, 0], :, 0] * w[OFFSETS[:, 1], :, 1] * w[OFFSETS[:, 2], :, 2]
        nodes = base[None] + OFFSETS[:, None] - low
        flat = ((nodes[..., 0] * shape[1] + nodes[..., 1]) * shape[2] + nodes[..., 2]).ravel()
        d = (base[None] + OFFSETS[:, None]) * dx - x
        affine = mass * c - dt * volume * 4 / dx**2 * kirchhoff(f)
        momentum = weight[..., None] * (mass * v + np.einsum("nij,knj->kni", affine, d))
        still = weight[..., None] * (mass * v + mass * np.einsum("nij,knj->kni", c, d))
        m = np.bincount(flat, (weight * mass).ravel(), shape.prod())
        filled = np.maximum(m, 1e-300)[:, None]
        grids = []
        for p in (momentum, still):
            sums = np.stack([np.bincount(flat, p[..., k].ravel(), shape.prod()) for k in range(3)], 1)
            grids.append(np.where(m[:, None] > 0, sums / filled, 0.0))
        new, old = grids[0] + dt * GRAVITY, grids[1]
        new[held] = 0
        at = weight[..., None] * new[flat].reshape(27, -1, 3)
        grid_v = at.sum(0)
        change = (weight[..., None] * (new - old)[flat].reshape(27, -1, 3)).sum(0)
        c = 4 / dx**2 * np.einsum("kni,knj->nij", at, d)
        v = keep * (v + change) + (1 - keep) * grid_v
        x = x + dt * grid_v
        f = f + dt * c @ f
        out.append(x[tip, 0].mean())
    about = {"grid_mm": 1e3 * dx, "particles": len(x), "substep_us": 1e6 * dt}
    return dt * np.arange(1, len(out) + 1), np.array(out), about


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=float, nargs="+", default=[3.0, 4.0], help="grid cells across the thickness")
    parser.add_argument("--keep", type=float, nargs="+", default=[0.0, 0.9, 1.0])
    parser.add_argument("--courant", type=float, default=0.6)
    parser.add_argument("--time", type=float, default=0.6, help="simulated [s]")
    asked = parser.parse_args()
    for cells, keep in itertools.product(asked.cells, asked.keep):
        began = time.perf_counter()
        times, tip, about = swung(cells, keep, asked.courant, asked.time)
        hz, rate, amplitude = swing(times, tip, 7.1)
        rough = float(np.abs(np.diff(tip, 2)).max() / np.abs(np.diff(tip)).max())
        print(json.dumps({
            "cells": cells, "keep": keep, **about, "hz": hz, "decay_per_s": rate, "amplitude_mm": 1e3 * amplitude,
            "roughness": rough, "seconds": time.perf_counter() - began,
        }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
