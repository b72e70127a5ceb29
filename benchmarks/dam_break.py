"""A water column that collapses over a dry floor, against measurements of its front.

    python benchmarks/dam_break.py --data DIR --cells 10 20 40 --plot dam_break.png
    python benchmarks/dam_break.py --cells 20 --sound 10 20 40      # no data: fronts alone

A column of water, ``a`` wide and ``2 a`` high, stands between a wall and a gate. The gate goes, and the front runs out:
Z = x_front / a over T = t sqrt(2 g / a). DIR holds martin_moyce_a1.125in.csv, martin_moyce_a2.25in.csv (Martin & Moyce
1952) and koshizuka_oka.csv (Koshizuka & Oka 1996, whose L is the width a), two columns T, Z each. See
docs/validation/dam_break.md.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import taichi as ti
import torch

from masiv import runtime
from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.planes import PlanesEffect, with_planes
from masiv.effects.context import EffectContext
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import substeps_per_frame
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator

GRAVITY, DENSITY, VISCOSITY = 9.81, 1000.0, 1.0e-3
FILES = ("martin_moyce_a1.125in.csv", "martin_moyce_a2.25in.csv", "koshizuka_oka.csv")
PIECE = 0.05
"""Of T, between two states that are looked at."""


def _slide_along(planes: int):
    @ti.func
    def tangential(x, v, t, dt, dx, c):
        out = v
        for p in ti.static(range(planes)):
            n = ti.Vector([c[4 * p], c[4 * p + 1], c[4 * p + 2]])
            if x.dot(n) <= c[4 * p + 3] + 1e-3 * dx:  # a plane of nodes in the wall belongs to it
                out -= out.dot(n) * n
        return out

    return tangential


class Walls(PlanesEffect):
    r"""$v_i \cdot n_p = 0$ for $n_p \cdot x_i \le h_p$, for each plane $p$: a wall without friction, or a plane of
    symmetry. Normals point into the matter and are perpendicular to each other, so that the order of walls in a corner
    does not matter. A plane with h beyond all matter makes the motion plane."""

    name = "walls"
    looks_like = "a part of the body slides along a wall"

    def node_velocity(self):
        return _slide_along(self.planes)


@dataclass(frozen=True)
class Flow:
    """At each T (K,): front Z (K,), centre of mass (K, 2) [m], mean of J − 1 and largest |J − 1| (K, 2), lowest
    coordinates of any particle along x and y (K, 2) [m]. steps of the simulation; seconds that they took."""

    times: np.ndarray
    front: np.ndarray
    centre: np.ndarray
    compression: np.ndarray
    lowest: np.ndarray
    particles: int
    steps: int
    seconds: float


def collapse(
    *, width: float = 0.05715, ratio: float = 2.0, cells: int = 20, until: float = 5.0, sound: float = 20.0,
    courant: float = 0.4, floor: str = "slip", per_cell: int = 2, piece: float = PIECE,
) -> Flow:  # fmt: skip
    """The collapse of a column ``width`` [m] wide and ``ratio`` times as high, to T = ``until``.

    Plane flow: one layer of particles (``per_cell`` a cell and axis) that may not move sideways. cells: across the
    column; sound: speed of sound in units of sqrt(g height); floor: slip or sticky.
    """
    height = ratio * width
    spacing = width / cells
    gap = spacing / per_cell
    across, up = (np.arange(round(side / gap)) * gap + 0.5 * gap for side in (width, height))
    x = torch.tensor(np.stack([*np.meshgrid(across, up, indexing="ij"), np.zeros((len(across), len(up)))], -1))
    x = x.reshape(-1, 3).float()
    bulk = DENSITY * sound**2 * GRAVITY * height
    law = ClassicalLaw("newtonian", viscosity=VISCOSITY, bulk_modulus=bulk)
    to_seconds = math.sqrt(width / (2 * GRAVITY))
    config = SimulatorConfig.model_validate({"courant_number": courant, "max_substeps_per_frame": 1 << 20})
    steps = substeps_per_frame(
        spacing=spacing, wave_modulus=law.wave_modulus(), density=DENSITY, speed=2 * math.sqrt(GRAVITY * height),
        frame_time=piece * to_seconds, config=config,
    )  # fmt: skip
    simulator = Simulator(
        particle_count=len(x), spacing=spacing, substep=piece * to_seconds / steps, volume=width * height * gap,
        density=DENSITY, gravity=(0.0, -GRAVITY, 0.0), contact=floor, memory_mb=200, max_substeps=64,
        grid_nodes=1 << (17 if cells <= 20 else 19), chunks=1,
    )  # fmt: skip
    setting = EffectContext(
        torch.tensor([0.0, -GRAVITY, 0.0]), x, DENSITY * gap * gap * gap, height, until * to_seconds
    )
    planes = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the wall; and nothing moves along z
    effects = with_planes(ActiveEffects((), setting), Walls, planes, torch.tensor([0.0, 1e3]))
    state = at_rest(x, torch.zeros_like(x), torch.zeros(len(x), 3, 3))
    began, rows, pieces = time.perf_counter(), [], round(until / piece)
    for k in range(pieces + 1):
        p = state.position.double()
        j = torch.linalg.det(state.trial_gradient.double())
        front = float(p[:, 0].max() + 0.5 * gap) / width
        compression = float(j.mean() - 1), float((j - 1).abs().max())
        rows.append([front, *p[:, :2].mean(0).tolist(), *compression, *p[:, :2].amin(0).tolist()])
        if k < pieces:
            state = simulator.run(state, law, steps, [], effects).final
    found = np.array(rows)
    return Flow(
        np.arange(pieces + 1) * piece, found[:, 0], found[:, 1:3], found[:, 3:5], found[:, 5:], len(x),
        steps * pieces, time.perf_counter() - began,
    )  # fmt: skip


def read_fronts(folder: Path) -> dict[str, np.ndarray]:
    """(T, Z) (K, 2) of each file in ``folder``."""
    return {name: np.loadtxt(folder / name, delimiter=",", skiprows=1) for name in FILES}


def misfit(flow: Flow, data: np.ndarray, until: float) -> dict[str, float]:
    """Root mean square error in Z up to T = ``until``, its mean; and the same if the clock of the measurement may
    have started at another instant (``late`` in T), since the gate opens for a while."""
    from scipy.optimize import minimize_scalar

    kept = data[data[:, 0] <= min(until, flow.times[-1] - 0.5)]

    def off(late: float) -> np.ndarray:
        return np.interp(kept[:, 0] - late, flow.times, flow.front) - kept[:, 1]

    best = minimize_scalar(lambda late: float((off(late) ** 2).mean()), bounds=(-0.5, 0.5), method="bounded")
    return {
        "points": len(kept), "rms": float(np.sqrt((off(0.0) ** 2).mean())), "mean": float(off(0.0).mean()),
        "late": float(best.x), "rms_late": math.sqrt(float(best.fun)),
    }  # fmt: skip


def scatter(data: dict[str, np.ndarray]) -> dict[str, float]:
    """How far measurements are from each other: root mean square of the differences in Z of each from Martin & Moyce's
    larger column, at times when both were measured (and for that, from the smaller)."""
    names = {name: FILES[0] if name == FILES[1] else FILES[1] for name in data}
    out = {}
    for name, other in names.items():
        mine, reference = data[name], data[other]
        inside = (mine[:, 0] >= reference[0, 0]) & (mine[:, 0] <= reference[-1, 0])
        off = np.interp(mine[inside, 0], reference[:, 0], reference[:, 1]) - mine[inside, 1]
        out[name] = float(np.sqrt((off**2).mean()))
    return out


def plot(flows: dict[str, Flow], data: dict[str, np.ndarray], path: Path) -> None:
    """Fronts over time, lines, and measurements, points."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 5))
    for name, flow in flows.items():
        axes.plot(flow.times, flow.front, label=name)
    for (name, points), mark in zip(data.items(), "os^", strict=False):
        axes.plot(points[:, 0], points[:, 1], mark, mfc="none", label=name.removesuffix(".csv"))
    last = max(flow.times[-1] for flow in flows.values())
    axes.set(xlabel="T = t sqrt(2 g / a)", ylabel="Z = x_front / a", xlim=(0, last), ylim=(1, 2 * last))
    axes.legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the measured fronts")
    parser.add_argument("--cells", type=int, nargs="+", default=[10, 20], help="grid cells across the column")
    parser.add_argument("--sound", type=float, nargs="+", default=[20.0], help="in units of sqrt(g height)")
    parser.add_argument("--floor", default="slip", choices=["slip", "sticky"])
    parser.add_argument("--until", type=float, default=6.0, help="last T")
    parser.add_argument("--width", type=float, default=0.05715, help="a [m]")
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    data = {}
    if asked.data is None or not all((asked.data / name).is_file() for name in FILES):
        print(
            f"no measured fronts in {asked.data}: --data takes the folder that holds {', '.join(FILES)}; fronts alone"
        )
    else:
        data = read_fronts(asked.data)
        print(json.dumps({"between_measurements": scatter(data)}))
    runtime.start("cpu")
    torch.set_num_threads(1)
    flows = {}
    for cells in asked.cells:
        for sound in asked.sound:
            flow = collapse(width=asked.width, cells=cells, sound=sound, until=asked.until, floor=asked.floor)
            flows[f"a / {cells}, sound {sound:g}"] = flow
            speed = np.gradient(flow.front, flow.times).max()
            print(json.dumps({
                "cells": cells, "sound": sound, "floor": asked.floor, "particles": flow.particles, "steps": flow.steps,
                "seconds": round(flow.seconds, 1), "fastest_front": speed,
                "volume_change": float(np.abs(flow.compression[:, 0]).max()),
                "front": {f"{t:g}": round(float(np.interp(t, flow.times, flow.front)), 3) for t in (1, 2, 3, 4, 5, 6)
                          if t <= asked.until},
                "misfit": {name: misfit(flow, points, asked.until) for name, points in data.items()},
            }), flush=True)  # fmt: skip
    if asked.plot:
        plot(flows, data, asked.plot)


if __name__ == "__main__":
    main()
