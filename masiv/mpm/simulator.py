"""The order of a substep, the memory of a rollout, and its adjoint."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch

from masiv import runtime
from masiv.effects.active import ActiveEffects, BoundEffects
from masiv.errors import MasivError, NonFiniteError
from masiv.materials.law import Law

WINDOW_EVERY = 8  # substeps between two fits of the grid's window to the particles
SERIAL = 3000
"""Particles up to which one thread that is launched once is faster than several that are launched for each substep."""
CONTACTS = ("sticky", "release", "slip", "none")


@functools.lru_cache(maxsize=8)
def _kernels(real: str, steps: int, particles: int, nodes: int, chunks: int):
    ti = runtime.start(runtime.running_arch())
    from masiv.kernels.mpm import MpmKernels

    gpu = runtime.running_arch() != "cpu"
    return MpmKernels(ti.f64 if real == "f64" else ti.f32, steps, particles, nodes, chunks, gpu)


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple


@dataclass(frozen=True)
class State:
    """Particles at one instant, simulation frame: position, velocity (N, 3) [m, m/s]; affine_velocity (N, 3, 3) [1/s];
    trial_gradient (N, 3, 3), the elastic deformation gradient before the return mapping."""

    position: torch.Tensor
    velocity: torch.Tensor
    affine_velocity: torch.Tensor
    trial_gradient: torch.Tensor

    def tensors(self) -> tuple[torch.Tensor, ...]:
        return self.position, self.velocity, self.affine_velocity, self.trial_gradient


class Simulator:
    """MLS-MPM for ``particle_count`` particles of one body, in the simulation frame (y up, ground at y = 0).

    spacing: grid cell [m]; substep [s]; volume: of the whole body at rest [m^3]; density [kg/m^3]; gravity (3,)
    [m/s^2]; contact: sticky (nodes in the ground are held), release (held while pressed, free to leave), slip (Coulomb
    friction with coefficient ``friction``) or none. memory_mb bounds the states kept for the adjoint: a longer rollout
    keeps only the state at the start of each segment and runs the segment again in the backward pass.
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
        self.count = particle_count
        self.spacing = spacing
        self.substep = substep
        self.dtype = dtype
        self.constants = {
            "substep": substep,
            "spacing": spacing,
            "volume": volume / particle_count,
            "gravity": tuple(float(g) for g in gravity),
            "friction": friction,
            "contact": CONTACTS.index(contact),
        }
        self.mass = torch.full((particle_count,), density * volume / particle_count, dtype=dtype)
        real = "f64" if dtype == torch.float64 else "f32"
        particles = _round_up(particle_count, 1024)
        bytes_a_step = particles * 42 * (8 if real == "f64" else 4)
        affordable = max(8, memory_mb * 1_000_000 // bytes_a_step)
        steps = min(_round_up(max_substeps, 64), 1 << int(math.log2(affordable)))
        self.k = _kernels(real, steps, particles, grid_nodes, chunks)

    def run(
        self,
        initial: State,
        law: Law,
        steps: int,
        outputs: list[int],
        effects: ActiveEffects | None = None,
        time: float = 0.0,
    ) -> Recording:
        """Simulate ``steps`` substeps. outputs: the substeps (ascending, 0 is the start) whose positions are wanted;
        time [s]: that of the start, for effects that depend on it.

        Raises NonFiniteError when a particle becomes non-finite or crosses more than a cell in a substep.
        """
        recording = Recording(self, law, steps, outputs, effects, time)
        recording.forward(initial)
        return recording

    # ---- one substep ---------------------------------------------------------------------------------------------

    def apply_constants(self, mass: torch.Tensor) -> None:
        """Write constants and masses (N,) [kg] to the fields, which simulators of the same capacity share."""
        c = self.constants
        values = [c["substep"], c["spacing"], c["volume"], *c["gravity"], c["friction"]]
        for index, value in enumerate(values):
            self.k.constants[index] = value
        self.k.write_mass(mass)
        self.k.contact[None] = c["contact"]

    def window(self, s: int, reckless: bool) -> tuple[int, ...]:
        """Origin and shape of the grid window for the next WINDOW_EVERY substeps, from local substep s.

        The margin covers twice the present top speed; ``reckless`` motion gets the most that the CFL limit allows.
        """
        box = self.k.bounds(s, self.count)
        cells = (
            WINDOW_EVERY if reckless else min(WINDOW_EVERY, 2.0 * WINDOW_EVERY * box[6] * self.substep / self.spacing)
        )
        margin = math.ceil(cells) + 1
        low = [math.floor(box[a] / self.spacing - 0.5) - margin for a in range(3)]
        high = [math.floor(box[3 + a] / self.spacing - 0.5) + 3 + margin for a in range(3)]
        shape = [h - w for h, w in zip(high, low, strict=True)]
        if math.prod(shape) > self.k.capacity_nodes:
            raise MasivError(
                f"the particles spread over {shape[0]} x {shape[1]} x {shape[2]} grid cells, more than the "
                f"{self.k.capacity_nodes} reserved: raise simulator.grid_nodes or simulator.particles_per_cell"
            )
        return (*low, *shape)

    def set_window(self, window: tuple[int, ...]) -> int:
        """Make ``window`` the current one; returns its number of nodes."""
        self.k.set_window(*window)
        return math.prod(window[3:])


@dataclass(frozen=True)
class Adjoint:
    """Adjoints of a rollout's inputs: initial state, the law's parameters, coefficients of the effects, masses (N,),
    and forces (N, 3) where there are any."""

    state: State
    law: tuple[torch.Tensor | None, ...]
    coefficients: list[torch.Tensor]
    mass: torch.Tensor
    force: torch.Tensor | None


class Recording:
    """What a rollout keeps: the positions asked for, and what its adjoint needs."""

    def __init__(
        self,
        simulator: Simulator,
        law: Law,
        steps: int,
        outputs: list[int],
        effects: ActiveEffects | None,
        time: float,
    ) -> None:
        self.simulator = simulator
        self.steps = steps
        self.outputs = {step: row for row, step in enumerate(outputs)}
        self.law = law
        self.bound = law.bind(simulator.k, simulator.count, simulator.substep)
        self.time = time
        members = effects.kernel_members if effects else []
        self.coefficients = effects.coefficients() if effects else []
        self.force = effects.force() if effects else None
        self.effects = BoundEffects(
            [(effect, c) for (effect, _), c in zip(members, self.coefficients, strict=True)],
            simulator.k,
            simulator.count,
            self.force,
        )
        factor = effects.mass_factor() if effects else None
        self.mass = simulator.mass if factor is None else simulator.mass * factor.to(simulator.dtype)
        self.segment = min(simulator.k.capacity_steps, steps)
        self.starts: list[State] = []
        self.windows: dict[int, tuple[int, ...]] = {}
        self.logs = {0: simulator.k.capacity_nodes}  # local substep where a window begins -> its first log entry
        self.positions = torch.empty(len(outputs), simulator.count, 3, dtype=simulator.dtype)

    def forward(self, initial: State) -> None:
        sim = self.simulator
        sim.apply_constants(self.mass.detach())
        self.effects.write()
        state = State(*(t.detach().to(sim.dtype).contiguous() for t in initial.tensors()))
        for start in range(0, self.steps, self.segment):
            self.starts.append(state)
            sim.k.owner = self
            sim.k.write_state(0, *state.tensors())
            length = min(self.segment, self.steps - start)
            self._advance(start, length)
            self._collect(start, length, first=start == 0)
            state = self.read(length)
        self.final = state

    def _advance(self, start: int, length: int) -> None:
        """Substeps start…start+length from the state at local substep 0."""
        block = 0
        while block < length:
            stop = min(block + WINDOW_EVERY, length)
            self._block(start, block, stop)
            block = stop

    def _block(self, start: int, begin: int, end: int) -> None:
        sim, k = self.simulator, self.simulator.k
        known = self.windows.get(start + begin)
        for reckless in (False, True):
            window = known or sim.window(begin, reckless)
            self.windows[start + begin] = window
            nodes = sim.set_window(window)
            self._substeps(start, begin, end, nodes)
            self.logs[end] = self.logs[begin] + (end - begin) * nodes
            too_fast, outside = k.read_fault()
            if too_fast >= 0:
                raise NonFiniteError(
                    start + (too_fast >> 32), too_fast & 0xFFFFFFFF, "non-finite or faster than a cell"
                )
            if outside < 0:
                return
        raise NonFiniteError(start + (outside >> 32), outside & 0xFFFFFFFF, "non-finite position")

    def _substeps(self, start: int, begin: int, end: int, nodes: int) -> None:
        """Substeps begin…end-1 within one window."""
        count, k = self.simulator.count, self.simulator.k
        serial = count <= SERIAL  # whatever the number of threads: the two kernels round differently
        whole = self.bound.substeps(k, serial) if self.effects.none else None
        if whole is not None:
            at_once = end - begin if serial else 1
            for s in range(begin, end, at_once):
                whole.advance(s, s + at_once, count, nodes, self.logs[begin] + (s - begin) * nodes)
            return
        for s in range(begin, end):
            self.effects.p2g(self.bound, s, nodes)
            self.effects.grid_update(self._log(s, nodes), self._instant(start + s))
            k.g2p(s, count)
            self.effects.after(s)

    def _instant(self, step: int) -> float:
        return self.time + step * self.simulator.substep

    def _log(self, s: int, nodes: int) -> int:
        """Where the grid of local substep s is kept for the adjoint, or 0 (scratch) where the log is full."""
        begin = s - s % WINDOW_EVERY
        offset = self.logs[begin] + (s - begin) * nodes
        return offset if offset + nodes <= self.simulator.k.capacity_log else 0

    def _collect(self, start: int, length: int, first: bool) -> None:
        for s in range(0 if first else 1, length + 1):
            row = self.outputs.get(start + s)
            if row is not None:
                self.simulator.k.read_position(s, self.positions[row])

    def read(self, s: int) -> State:
        """The state at local substep s of the segment in memory."""
        sim = self.simulator
        shapes = ((3,), (3,), (3, 3), (3, 3))
        out = tuple(torch.empty(sim.count, *shape, dtype=sim.dtype) for shape in shapes)
        sim.k.read_state(s, *out)
        return State(*out)

    def backward(self, positions_bar: torch.Tensor) -> Adjoint:
        """From the adjoint (K, N, 3) of the output positions."""
        sim, k = self.simulator, self.simulator.k
        sim.apply_constants(self.mass.detach())
        self.effects.write()
        k.clear_bars(sim.count)
        bars = positions_bar.detach().to(sim.dtype).contiguous()
        for index in reversed(range(len(self.starts))):
            start = index * self.segment
            length = min(self.segment, self.steps - start)
            if k.owner is not self or len(self.starts) > 1:
                # The fields hold another rollout, or another segment of this one: run this segment again.
                k.owner = self
                k.write_state(0, *self.starts[index].tensors())
                self._advance(start, length)
            current = None
            for s in reversed(range(length)):
                row = self.outputs.get(start + s + 1)
                if row is not None:
                    k.add_position_bar(bars[row])
                window = self.windows[start + s - s % WINDOW_EVERY]
                if window is not current:
                    nodes, current = sim.set_window(window), window
                offset = self._log(s, nodes)
                if offset:
                    k.grid_velocities(offset)
                else:
                    k.p2g(s, sim.count, nodes)
                    k.grid_update(offset)
                instant = self._instant(start + s)
                self.effects.grid_velocities(offset, nodes, instant)
                self.effects.after_adjoint(s)
                k.g2p_adjoint(s, sim.count, nodes)
                if self.effects.on_grid:
                    self.effects.grid_adjoint(offset, nodes, instant)
                else:
                    k.grid_adjoint(offset)
                k.p2g_adjoint(s, sim.count)
                self.effects.stress_adjoint(self.bound, s)
                self.bound.backward(s, sim.count)
        if 0 in self.outputs:
            k.add_position_bar(bars[self.outputs[0]])
        shapes = ((3,), (3,), (3, 3), (3, 3))
        out = tuple(torch.empty(sim.count, *shape, dtype=sim.dtype) for shape in shapes)
        k.read_bars(*out)
        mass = torch.empty(sim.count, dtype=sim.dtype)
        k.read_mass_bar(mass)
        force = self.effects.force_gradient()
        if force is not None:
            k.owner = None  # their adjoint undoes the states
        return Adjoint(State(*out), self.bound.parameter_gradients(), self.effects.gradients(), mass, force)
