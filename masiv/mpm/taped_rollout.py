r"""A rollout and its adjoint.

A substep maps the state $z_s = (x, v, C, F)$ of the particles to $z_{s+1}$ (``masiv.kernels.mpm``). ``_substep`` and
``_substep_adjoint`` are mirrors of each other: the adjoint calls the adjoints of the same four parts in reverse order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.bound import BoundEffects
from masiv.errors import NonFiniteError
from masiv.materials.law import Law
from masiv.mpm.state import State
from masiv.mpm.tape import Segment, Tape
from masiv.mpm.window import WINDOW_EVERY, Window, fit_window

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels

SERIAL_PARTICLES = 3000
"""Particles up to which one thread that is launched once is faster than several that are launched for each substep."""


@dataclass(frozen=True)
class Constants:
    """What the kernels need in addition to the state: substep [s]; spacing: grid cell [m]; volume of a particle at rest
    [m^3]; gravity (3,) [m/s^2]; friction: Coulomb's coefficient [1]; contact: index into ``simulator.CONTACTS``."""

    substep: float
    spacing: float
    volume: float
    gravity: tuple[float, float, float]
    friction: float
    contact: int

    def write(self, kernels: MpmKernels, mass: torch.Tensor) -> None:
        """To the fields, which simulators of the same capacity share; mass (N,) [kg]."""
        values = [self.substep, self.spacing, self.volume, *self.gravity, self.friction]
        for index, value in enumerate(values):
            kernels.constants[index] = value
        kernels.write_mass(mass)
        kernels.contact[None] = self.contact


@dataclass(frozen=True)
class Adjoint:
    """Adjoints of a rollout's inputs: initial state, the law's parameters, coefficients of the effects, masses (N,),
    and forces (N, 3), None if there are none."""

    state: State
    law: tuple[torch.Tensor | None, ...]
    coefficients: list[torch.Tensor]
    mass: torch.Tensor
    force: torch.Tensor | None


class TapedRollout:
    """A rollout of ``steps`` substeps: the positions (K, N, 3) [m] at ``outputs``, and what its adjoint needs.

    mass (N,) [kg] without effects; time [s] of the start. The fields of ``kernels`` are shared: a rollout that does
    not own them any more runs its segments again in ``backward``.
    """

    def __init__(
        self,
        kernels: MpmKernels,
        constants: Constants,
        mass: torch.Tensor,
        law: Law,
        steps: int,
        outputs: list[int],
        effects: ActiveEffects | None,
        time: float,
    ) -> None:
        self.kernels = kernels
        self.constants = constants
        self.count, self.dtype = len(mass), mass.dtype
        self.steps = steps
        self.time = time
        self.bound = law.bind(kernels, self.count, constants.substep)
        self.effects = BoundEffects(effects, kernels, self.count)
        factor = self.effects.mass_factor
        self.mass = mass if factor is None else mass * factor.to(self.dtype)
        self.tape = Tape(kernels.capacity_nodes, kernels.capacity_log)
        self.outputs = {step: row for row, step in enumerate(outputs)}
        self.positions = torch.empty(len(outputs), self.count, 3, dtype=self.dtype)

    # ---- forward ---------------------------------------------------------------------------------------------------

    def forward(self, initial: State) -> None:
        """Simulate from ``initial``. Raises NonFiniteError."""
        self._write_constants()
        known = initial.internal_variables
        state = State(
            *(t.detach().to(self.dtype).contiguous() for t in initial.tensors()),
            internal_variables=None if known is None else known.detach().to(self.dtype).contiguous(),
            suspended=initial.suspended,
        )
        length = min(self.kernels.capacity_steps, self.steps)
        for start in range(0, self.steps, length):
            segment = Segment(start, min(length, self.steps - start), state)
            self.tape.segments.append(segment)
            self._simulate(segment)
            for s in range(0 if start == 0 else 1, segment.length + 1):
                row = self.outputs.get(start + s)
                if row is not None:
                    self.kernels.read_position(s, self.positions[row])
            state = self.read(segment.length)
        self.final = state

    def read(self, s: int) -> State:
        """The state at local substep s of the segment that is in the fields."""
        out = State.empty(self.count, self.dtype)
        self.kernels.read_state(s, *out.tensors())
        return replace(out, internal_variables=self.effects.read_internal(s), suspended=self.effects.read_suspended(s))

    def read_stress(self, s: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Elastic deformation gradient and Kirchhoff stress [Pa], (N, 3, 3), in local substep s of the segment that is
        in the fields: after the law and the effects on the stress."""
        gradient, kirchhoff = (torch.empty(self.count, 3, 3, dtype=self.dtype) for _ in range(2))
        self.kernels.read_stress(s, gradient, kirchhoff)
        return gradient, kirchhoff

    def _write_constants(self) -> None:
        self.constants.write(self.kernels, self.mass.detach())
        self.effects.write()

    def _simulate(self, segment: Segment) -> None:
        """Fill the fields with the states of ``segment``, which they then belong to."""
        self.kernels.owner = self
        self.kernels.write_state(0, *segment.initial.tensors())
        self.effects.write_internal(segment.initial.internal_variables, segment.start == 0)
        self.effects.write_suspended(segment.initial.suspended)
        for begin in range(0, segment.length, WINDOW_EVERY):
            self._block(segment, begin, min(begin + WINDOW_EVERY, segment.length))

    def _block(self, segment: Segment, begin: int, end: int) -> None:
        """Local substeps begin … end - 1 in one window; a second time in the largest one, if particles leave it."""
        constants = self.constants
        known = self.tape.window(segment.start + begin)
        outside: tuple[int, int] | None = None
        for max_margin in (False, True):
            window = known or fit_window(
                self.kernels, begin, self.count, constants.substep, constants.spacing, max_margin=max_margin
            )
            self.kernels.set_window(*window.origin, *window.shape)
            self.tape.add_block(segment, begin, end, window)
            self._substeps(segment, begin, end, window.nodes)
            too_fast, outside = self.kernels.read_errors()
            if too_fast is not None:
                raise NonFiniteError(segment.start + too_fast[0], too_fast[1], "non-finite or faster than a cell")
            if outside is None:
                return
        assert outside is not None
        raise NonFiniteError(segment.start + outside[0], outside[1], "non-finite position")

    def _substeps(self, segment: Segment, begin: int, end: int, nodes: int) -> None:
        # For any number of threads: the two kernels round differently.
        serial = not self.kernels.gpu and self.count <= SERIAL_PARTICLES
        # With several threads a launch is for one substep: three with effects are not worth a kernel of all of it.
        fused = serial or self.kernels.gpu or self.effects.empty
        whole = self.bound.substeps(self.kernels, self.effects.forward, serial) if fused else None
        if whole is not None:
            at_once = end - begin if serial else 1
            for s in range(begin, end, at_once):
                whole.advance(s, s + at_once, self.count, nodes, self.tape.log_entry(s, nodes), self._time(segment, s))
            return
        for s in range(begin, end):
            self._substep(s, self._time(segment, s), nodes)

    def _time(self, segment: Segment, s: int) -> float:
        """Time [s] at the start of local substep s."""
        return self.time + (segment.start + s) * self.constants.substep

    # ---- a substep and its mirror ----------------------------------------------------------------------------------

    def _substep(self, s: int, time: float, nodes: int) -> None:
        """The state at local substep s -> that at s + 1."""
        self.effects.p2g(self.bound, s, nodes)
        self.effects.grid_update(self.tape.log_offset(s, nodes), nodes, time)
        self.kernels.g2p(s, self.count)
        self.effects.apply_forces(s)

    def _substep_adjoint(self, s: int, time: float, nodes: int) -> None:
        """The adjoint of the state at local substep s + 1 -> that at s, in the fields ``*_bar``."""
        offset, adjoint = self.tape.log_offset(s, nodes), self.effects.adjoint
        adjoint.restore_grid(s, offset, nodes, time)
        adjoint.apply_forces(s)
        self.kernels.g2p_adjoint(s, self.count, nodes)
        adjoint.grid_update(offset, nodes, time)
        adjoint.p2g(self.bound, s)

    # ---- backward --------------------------------------------------------------------------------------------------

    def backward(self, positions_bar: torch.Tensor) -> Adjoint:
        """Adjoints of the inputs from that of ``positions``, (K, N, 3)."""
        self._write_constants()
        self.effects.adjoint.write()
        self.kernels.clear_bars(self.count)
        bars = positions_bar.detach().to(self.dtype).contiguous()
        for segment in reversed(self.tape.segments):
            if self.kernels.owner is not self or len(self.tape.segments) > 1:
                self._simulate(segment)  # the fields hold another rollout, or another segment of this one
            window: Window | None = None
            for s in reversed(range(segment.length)):
                self._add_output_bar(segment.start + s + 1, bars)
                if self.tape.window(segment.start + s) is not window:
                    window = self.tape.window(segment.start + s)
                    assert window is not None
                    self.kernels.set_window(*window.origin, *window.shape)
                assert window is not None
                self._substep_adjoint(s, self._time(segment, s), window.nodes)
        self._add_output_bar(0, bars)
        return self._read_adjoint()

    def _add_output_bar(self, step: int, bars: torch.Tensor) -> None:
        row = self.outputs.get(step)
        if row is not None:
            self.kernels.add_position_bar(bars[row])

    def _read_adjoint(self) -> Adjoint:
        state = State.empty(self.count, self.dtype)
        self.kernels.read_bars(*state.tensors())
        mass = torch.empty(self.count, dtype=self.dtype)
        self.kernels.read_mass_bar(mass)
        adjoint = self.effects.adjoint
        force = adjoint.force_gradient()
        if force is not None:
            self.kernels.owner = None  # their adjoint undoes the states
        return Adjoint(
            state, self.bound.parameter_gradients(), self.effects.adjoint.coefficient_gradients(), mass, force
        )
