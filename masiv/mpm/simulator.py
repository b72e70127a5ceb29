"""The simulator of one body: constants, capacities and the start of a rollout, by MLS-MPM or of springs."""

from __future__ import annotations

import functools
import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from masiv import runtime
from masiv.effects.active import ActiveEffects
from masiv.errors import InputError
from masiv.materials.law import Law
from masiv.mpm.spring_rollout import SpringRollout
from masiv.mpm.state import State
from masiv.mpm.taped_rollout import Constants, TapedRollout

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

CONTACTS = ("sticky", "release", "slip", "none")
PARTICLES_UNIT, SUBSTEPS_UNIT = 1024, 64
"""Capacities are multiples of these: fields are compiled for their size, and are never freed."""
FLOATS_A_STATE = 42
"""Of a particle: position, velocity, C, trial F, elastic F, Kirchhoff stress."""


@functools.cache
def _shared_kernels(real: str, steps: int, particles: int, nodes: int, chunks: int):
    """The fields and kernels of a capacity. All simulators of the process with this capacity use them in turn.

    This is the one global state of the package's numerics: laws and effects attach their own fields to these
    (``MpmKernels.attached``). Who finds that another rollout has used the fields (``owner``) writes them again. Nothing
    is evicted, since Taichi frees no field before the process ends: capacities are rounded up, so that a process needs
    few of them, each of about ``memory_mb`` at most.
    """
    ti = runtime.start(runtime.running_arch())
    from masiv.kernels.mpm import MpmKernels

    gpu = runtime.running_arch() != "cpu"
    return MpmKernels(ti.f64 if real == "f64" else ti.f32, steps, particles, nodes, chunks, gpu)


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple


class Simulator:
    """MLS-MPM for ``particle_count`` particles of one body, in the simulation frame (y up, ground at y = 0).

    spacing: grid cell [m]; substep [s]; volume: of the whole body at rest [m^3]; density [kg/m^3]; gravity (3,)
    [m/s^2]; contact: sticky (nodes in the ground are held), release (held while pressed, free to leave), slip (Coulomb
    friction with coefficient ``friction``) or none. memory_mb bounds the states and grids kept for the adjoint: a
    longer rollout keeps only the state at the start of each segment and runs the segment again in the backward pass.
    max_substeps: substeps of a rollout that are kept at once, if memory allows. grid_nodes: nodes reserved for the
    window around the body. chunks of particles that scatter apart on a CPU.

    Raises InputError for numbers that are not positive or not finite, and for an unknown contact.
    """

    def __init__(
        self,
        *,
        particle_count: int,
        spacing: float,
        substep: float,
        volume: float,
        density: float,
        gravity: tuple[float, float, float] | np.ndarray,
        contact: str = "sticky",
        friction: float = 0.0,
        dtype: torch.dtype = torch.float32,
        memory_mb: int = 1500,
        max_substeps: int = 1024,
        grid_nodes: int = 1 << 18,
        chunks: int = 2,
    ) -> None:
        positive = {"particle_count": particle_count, "spacing": spacing, "substep": substep, "volume": volume,
                    "density": density}  # fmt: skip
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise InputError(f"simulator: {name} = {value}, give a positive number")
        if np.shape(gravity) != (3,):
            raise InputError(f"simulator: gravity has shape {np.shape(gravity)}, give three numbers [m/s^2]")
        if contact not in CONTACTS:
            raise InputError(f"simulator: unknown contact '{contact}', use one of {', '.join(CONTACTS)}")
        if dtype not in (torch.float32, torch.float64):
            raise InputError(f"simulator: dtype {dtype}, give torch.float32 or torch.float64")
        if dtype == torch.float64:
            runtime.check_float64("simulator: dtype torch.float64")
        self.count = particle_count
        self.spacing = spacing
        self.substep = substep
        self.dtype = dtype
        self.constants = Constants(
            substep=substep,
            spacing=spacing,
            volume=volume / particle_count,
            gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
            friction=friction,
            contact=CONTACTS.index(contact),
        )
        self.mass = torch.full((particle_count,), density * volume / particle_count, dtype=dtype)
        self._memory_mb, self._max_substeps = memory_mb, max_substeps
        self._grid_nodes, self._chunks = grid_nodes, chunks

    @functools.cached_property
    def kernels(self) -> MpmKernels:
        """Those of MLS-MPM for the body's capacity, made if a rollout needs them."""
        real, size = ("f64", 8) if self.dtype == torch.float64 else ("f32", 4)
        particles = _round_up(self.count, PARTICLES_UNIT)
        steps = _kept_substeps(particles, self._memory_mb, self._max_substeps, size)
        return _shared_kernels(real, steps, particles, self._grid_nodes, self._chunks)

    def run(
        self,
        initial: State,
        law: Law,
        steps: int,
        outputs: list[int],
        effects: ActiveEffects | None = None,
        time: float = 0.0,
    ) -> TapedRollout | SpringRollout:
        """Simulate ``steps`` substeps from ``initial``.

        outputs: the substeps (ascending, 0 is the start) whose positions are wanted. time [s] of the start, for effects
        that depend on it. Raises InputError for tensors of another number of particles and for outputs that are not
        ascending substeps of the rollout; NonFiniteError if a particle becomes non-finite or crosses more than a cell
        in a substep.
        """
        initial.check(self.count)
        if steps < 1:
            raise InputError(f"a rollout of {steps} substeps: give at least 1")
        if any(a >= b for a, b in itertools.pairwise(outputs)) or any(not 0 <= s <= steps for s in outputs):
            raise InputError(f"outputs must be ascending substeps from 0 to {steps}")
        if effects is not None and effects.context.rest.shape != (self.count, 3):
            raise InputError(
                f"effects are of a body of {len(effects.context.rest)} particles, the simulator is of {self.count}"
            )
        rollout: TapedRollout | SpringRollout
        if law.kind == "springs":
            memory = self._memory_mb
            rollout = SpringRollout(self.constants, self.mass, law, steps, outputs, effects, time, memory)
        else:
            rollout = TapedRollout(self.kernels, self.constants, self.mass, law, steps, outputs, effects, time)
        rollout.forward(initial)
        return rollout


def kernels_bytes(particles: int, memory_mb: int, max_substeps: int, grid_nodes: int, chunks: int) -> int:
    """Memory [bytes] that a process reserves for float32 simulators of one capacity (``Simulator``): the states and the
    log of grids that are kept, and the grids: (momentum, mass) of each chunk, velocities, and the adjoints of both."""
    particles = _round_up(particles, PARTICLES_UNIT)
    states = _kept_substeps(particles, memory_mb, max_substeps, 4) * floats_a_substep(particles)
    return 4 * (states + (4 * chunks + 11) * grid_nodes)


def _kept_substeps(particles: int, memory_mb: int, max_substeps: int, size: int) -> int:
    """How many substeps are kept at once of ``particles``, a number that was rounded up. size: of a number [bytes]."""
    affordable = max(8, memory_mb * 1_000_000 // (size * floats_a_substep(particles)))
    return min(_round_up(max_substeps, SUBSTEPS_UNIT), 1 << int(math.log2(affordable)))


def floats_a_substep(particles: int) -> int:
    """Numbers kept for a substep of ``particles`` particles: their states, and (momentum, mass) of nodes in the log."""
    from masiv.kernels.mpm import log_entries_a_substep

    return FLOATS_A_STATE * particles + 4 * log_entries_a_substep(particles)
