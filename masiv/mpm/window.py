"""The window of the grid that follows the particles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from masiv.errors import MasivError

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

WINDOW_EVERY = 8
"""Substeps between two fits of the window to the particles."""


class Window(NamedTuple):
    """A box of nodes of the lattice spacing · Z^3: its lowest node and its numbers of nodes along x, y, z."""

    origin: tuple[int, int, int]
    shape: tuple[int, int, int]

    @property
    def nodes(self) -> int:
        return math.prod(self.shape)


def fit_window(k: MpmKernels, s: int, count: int, substep: float, spacing: float, *, max_margin: bool) -> Window:
    """The window for the next ``WINDOW_EVERY`` substeps from local substep s.

    Its margin covers twice the present top speed; with ``max_margin`` it is the most that the CFL condition allows.
    substep [s]; spacing: cell [m]. Raises MasivError if it has more nodes than are reserved.
    """
    box = k.bounds(s, count)
    cells = WINDOW_EVERY if max_margin else min(WINDOW_EVERY, 2.0 * WINDOW_EVERY * box[6] * substep / spacing)
    margin = math.ceil(cells) + 1
    low = [math.floor(box[a] / spacing - 0.5) - margin for a in range(3)]
    high = [math.floor(box[3 + a] / spacing - 0.5) + 3 + margin for a in range(3)]
    x, y, z = (h - w for h, w in zip(high, low, strict=True))
    window = Window((low[0], low[1], low[2]), (x, y, z))
    if window.nodes > k.capacity_nodes:
        raise MasivError(
            f"the particles spread over {x} x {y} x {z} grid cells, more than the {k.capacity_nodes} reserved: raise "
            "simulator.grid_nodes or simulator.particles_per_cell"
        )
    return window
