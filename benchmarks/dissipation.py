"""How fast the simulator itself damps a swing: a clamped neo-Hookean bar with no viscosity, released under its weight.

    python benchmarks/dissipation.py --cells 4 6 8 --courant 0.3 --poisson 0.45 --time 1.0

The bar is 30 x 30 x 100 mm of silicone. For each grid (cells across its thickness) and Courant number: the frequency
and the decay rate of its tip, by fitting A exp(-γ t) cos(ω t + φ) + B, and the frequency of Timoshenko's cantilever.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import expm
from scipy.optimize import brentq, least_squares

from masiv import runtime
from masiv.materials.classical import ClassicalLaw
from masiv.models.marked_body import marked_body
from masiv.mpm.config import SimulatorConfig
from masiv.tracks.declaration import GeometryDeclaration
from masiv.tracks.geometry import make_geometry
from masiv.tracks.placement import Placement
from masiv.tracks.tracks import Clamp, Run, TrackedBody, Tracks

THICKNESS, LENGTH, DENSITY = 0.03, 0.1, 1070.0


def bar(thickness: float = THICKNESS, length: float = LENGTH, gravity: float = 9.8) -> Tracks:
    """A bar along z from 0 to ``length`` [m], held at z <= 0; gravity along -x. One marker in the middle of its tip."""
    declared = GeometryDeclaration(units="m", box=(thickness, thickness, length))
    geometry = make_geometry(declared, Path())
    clamp = Clamp(np.array([[0.0, 0.0, 1.0]]), np.array([-length / 2]), ())
    body = TrackedBody("bar", "bar", geometry, DENSITY, DENSITY * geometry.volume, None, (clamp,))
    tip = np.array([0.0, 0.0, length])
    placement = Placement(np.eye(3), np.array([0.0, 0.0, length / 2]))
    run = Run("tip", "bar", "", "fit", ("tip",), np.array([0.0, 1.0, 2.0]), np.tile(tip, (3, 1, 1)), 1.0, slice(0, 3),
              tip[None], None, 0.0, placement)  # fmt: skip
    return Tracks(Path("bar"), np.array([1.0, 0, 0]), np.array([-gravity, 0, 0]), None, {"bar": body}, (run,))


def cantilever_hz(youngs: float, poisson: float, thickness: float = THICKNESS, length: float = LENGTH) -> float:
    """First frequency [Hz] of Timoshenko's cantilever, square section, shear coefficient 10(1+ν)/(12+11ν) (Cowper)."""
    area, inertia = thickness**2, thickness**4 / 12
    shear = youngs / (2 * (1 + poisson)) * 10 * (1 + poisson) / (12 + 11 * poisson) * area
    bending, mass, rotary = youngs * inertia, DENSITY * area, DENSITY * inertia

    def determinant(omega: float) -> float:
        """Of the conditions at the free end over the two solutions that are clamped at 0 (transfer matrix)."""
        a = np.array([[0, 1, 0, 1 / shear], [0, 0, 1 / bending, 0], [0, -rotary * omega**2, 0, -1.0],
                      [-mass * omega**2, 0, 0, 0]])  # fmt: skip
        return float(np.linalg.det(expm(a * length)[2:, 2:]))  # state: deflection, rotation, moment, force

    euler = 1.875104**2 / (2 * math.pi * length**2) * math.sqrt(bending / mass)
    grid = 2 * math.pi * np.linspace(0.3, 1.1, 60) * euler
    values = [determinant(omega) for omega in grid]
    k = int(np.flatnonzero(np.diff(np.sign(values)))[0])
    return brentq(determinant, grid[k], grid[k + 1]) / (2 * math.pi)


def swing(times: np.ndarray, x: np.ndarray, guess_hz: float) -> tuple[float, float, float]:
    """Frequency [Hz], decay rate [1/s] and amplitude of x (T,) at times (T,) [s]."""

    def model(p: np.ndarray) -> np.ndarray:
        return p[0] + np.exp(-p[1] * times) * (
            p[2] * np.cos(2 * math.pi * p[3] * times) + p[4] * np.sin(2 * math.pi * p[3] * times)
        )

    scale = np.std(x)
    best = None
    for ratio in np.linspace(0.8, 1.2, 9):
        start = np.array([x.mean() / scale, 0.1, 1.0, ratio * guess_hz, 0.0])
        found = least_squares(lambda p: model(p) - x / scale, start, x_scale=[1, 1, 1, 0.1, 1])
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    p = best.x
    return float(p[3]), float(p[1]), float(scale * math.hypot(p[2], p[4]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=float, nargs="+", default=[4.0, 6.0], help="grid cells across the thickness")
    parser.add_argument("--courant", type=float, nargs="+", default=[0.3], help="Courant numbers")
    parser.add_argument("--ppc", type=int, default=8, help="particles a cell: 8, 27 or 64")
    parser.add_argument("--youngs", type=float, default=264e3, help="[Pa]")
    parser.add_argument("--poisson", type=float, default=0.45)
    parser.add_argument("--time", type=float, default=0.6, help="simulated [s]")
    asked = parser.parse_args()
    runtime.start("cpu")
    torch.set_num_threads(1)
    theory = cantilever_hz(asked.youngs, asked.poisson)
    print(json.dumps({"theory_hz": theory}))
    times = np.arange(0, asked.time, 2e-3)
    law = ClassicalLaw("neo_hookean", youngs_modulus=asked.youngs, poissons_ratio=asked.poisson)
    scene = bar()
    for cells in asked.cells:
        for courant in asked.courant:
            config = SimulatorConfig(particles_per_cell=asked.ppc, courant_number=courant, max_substeps_per_frame=2000)
            began = time.perf_counter()
            spacing = THICKNESS / cells / round(asked.ppc ** (1 / 3))
            body = marked_body(scene, scene.runs[0], config, particle_spacing=spacing, speed=0.5)
            tip = body.markers_to_world(body.run(law, times)[1])[:, 0, 0]
            hz, rate, amplitude = swing(times, tip, theory)
            print(json.dumps({
                "cells": cells, "grid_mm": 1e3 * body.spacing, "particles": len(body.particles), "courant": courant,
                "substep_us": 1e6 * body.substep(law, times), "hz": hz,
                "hz_error": hz / theory - 1, "decay_per_s": rate, "amplitude_mm": 1e3 * amplitude,
                "seconds": time.perf_counter() - began,
            }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
