"""A rollout of a body of springs and its adjoint: the interface of ``TapedRollout``, without a grid."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from masiv import runtime
from masiv.effects.active import ActiveEffects
from masiv.effects.effect import ContactEffect, NodalEffect, StressEffect, SuspendedMassEffect
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.local_gradient import local_gradients
from masiv.materials.law import Law
from masiv.mpm.spring_graph import spring_graph
from masiv.mpm.state import State
from masiv.mpm.taped_rollout import SERIAL_PARTICLES, Adjoint, Constants

STABLE = 2.0
"""Substeps dt keep dt² k + 2 dt c at most at this; the limit of stability is 4 (``masiv.mpm.design``)."""
MAX_DIVISION = 64
"""Parts of a substep, at most, for springs that are stiffer, or more viscous, than their continuum asks for."""


@dataclass(frozen=True)
class SpringEffects:
    """Inputs that effects give, differentiable: as ``BoundEffects``."""

    coefficients: list[torch.Tensor]
    force: torch.Tensor | None
    mass_factor: torch.Tensor | None


class SpringRollout:
    """A rollout of ``steps`` substeps of particles that springs connect (``masiv.mpm.spring_graph``).

    mass (N,) [kg] without effects; time [s] of the start. Effects on the nodes of the grid act on the particles.
    Raises MasivError for an effect on the stress, which springs do not have, for a suspended mass, and for springs that
    need too short a substep.
    """

    def __init__(
        self,
        constants: Constants,
        mass: torch.Tensor,
        law: Law,
        steps: int,
        outputs: list[int],
        effects: ActiveEffects | None,
        time: float,
        memory_mb: int,
    ) -> None:
        self.ti = runtime.start(runtime.running_arch())
        self.constants, self.law, self.steps, self.time = constants, law, steps, time
        self.count, self.dtype = len(mass), mass.dtype
        self.members: list[NodalEffect | ContactEffect] = []
        for effect, _ in effects.kernel_members if effects else ():
            if isinstance(effect, StressEffect):
                raise MasivError(
                    f"effect {effect.name} acts on the stress, which springs do not have: choose another law"
                )
            self.members.append(effect)
        if effects is not None and effects.of_kind(SuspendedMassEffect):
            raise MasivError("springs carry no suspended mass: choose another law")
        self.effects = SpringEffects(
            effects.coefficients() if effects else [],
            effects.force() if effects else None,
            effects.mass_factor() if effects else None,
        )
        factor = self.effects.mass_factor
        self.mass = mass if factor is None else mass * factor.to(self.dtype)
        self.outputs = {step: row for row, step in enumerate(outputs)}
        self.positions = torch.empty(len(outputs), self.count, 3, dtype=self.dtype)
        self.memory_mb = memory_mb
        self.serial = runtime.running_arch() == "cpu" and self.count <= SERIAL_PARTICLES

    # ---- forward ---------------------------------------------------------------------------------------------------

    def forward(self, initial: State) -> None:
        """Simulate from ``initial``. Raises InputError for one that is deformed if positions at rest are not known;
        NonFiniteError."""
        self.rest = rest_of(initial).detach().double()
        self.graph = spring_graph(self.rest.numpy())
        self._spring_inputs()
        self.parts = self._division()
        whole = self.steps * self.parts
        a_substep = 6 * self.count * torch.finfo(self.dtype).bits // 8
        length = min(whole, max(self.parts, int(self.memory_mb * 1e6 / a_substep) // self.parts * self.parts))
        state = tuple(t.detach().to(self.dtype).contiguous() for t in (initial.position, initial.velocity))
        self.segments: list[tuple[int, int, tuple[torch.Tensor, ...]]] = []
        self._allocate(length)
        for start in range(0, whole, length):
            self.segments.append((start, min(length, whole - start), state))
            self._simulate(len(self.segments) - 1)
            end = min(start + length, whole)
            for step, row in self.outputs.items():
                if start <= step * self.parts <= end:
                    _kernels().read_row(self.x, step * self.parts - start, self.positions[row])
            state = (self._row(self.x, end - start), self._row(self.v, end - start))
        self._last = state

    @cached_property
    def final(self) -> State:
        """The state at the end."""
        return self._state(*self._last)

    def read_stress(self, s: int) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``TapedRollout.read_stress``: deformation gradient of the neighbourhood, and the stress of a solid of
        such springs without their dampers."""
        gradient = self._gradient(self._row(self.x, s * self.parts), self.rest)
        return gradient, self.law.stress(gradient).detach().to(self.dtype)

    def _row(self, array: Any, s: int) -> torch.Tensor:
        out = torch.empty(self.count, 3, dtype=self.dtype)
        _kernels().read_row(array, s, out)
        return out

    def _state(self, x: torch.Tensor, v: torch.Tensor) -> State:
        return State(x, v, self._gradient(v, x), self._gradient(x, self.rest), rest_position=self.rest)

    def _gradient(self, of: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
        """Gradient (N, 3, 3) of a vector (N, 3) by another in the neighbourhood of each particle."""
        own = np.concatenate([np.arange(self.count)[:, None], self.graph.neighbours], axis=1)
        found = local_gradients(by.double().numpy()[own], of.double().numpy()[own])
        return torch.from_numpy(found).to(self.dtype)

    def _spring_inputs(self) -> None:
        """Stiffness [N] and damping [N s/m] of the bonds (E,), differentiable by the law's parameters. A damper
        dissipates as viscosity does in shear: 15/2 η in place of 3 E."""
        lengths, weights = (torch.from_numpy(a) for a in (self.graph.lengths, self.graph.weights))
        energy = 2.0 * self.constants.volume * weights
        parameters = self.law.get_parameter
        self.stiffness = 3.0 * parameters("values.youngs_modulus") * energy / lengths
        self.damping = 7.5 * parameters("values.viscosity") * energy / lengths**2

    def _division(self) -> int:
        """Parts of a substep for which the springs are stable, by Gershgorin's bound on their frequencies."""
        rows = np.repeat(np.arange(self.count), np.diff(self.graph.offsets))
        mass = self.mass.detach().double().numpy()

        def highest(values: torch.Tensor) -> float:
            return float((2.0 * np.bincount(rows, values.detach().numpy(), self.count) / mass).max())

        k, c = highest(self.stiffness / torch.from_numpy(self.graph.lengths)), highest(self.damping)
        longest = (math.sqrt(c * c + STABLE * k) - c) / k
        parts = max(1, math.ceil(self.constants.substep / longest * (1 - 1e-9)))
        if parts > MAX_DIVISION:
            raise MasivError(
                f"springs with this stiffness and viscosity need substeps of {longest:.2g} s, "
                f"{self.constants.substep:.2g} s are taken: they are too stiff, or too viscous"
            )
        return parts

    def _allocate(self, length: int) -> None:
        """Arrays on the device, of a segment of ``length`` substeps and of what does not change."""
        ti = self.ti
        self.real = ti.f64 if self.dtype == torch.float64 else ti.f32
        self.x, self.v = (ti.ndarray(self.real, (length + 1, self.count, 3)) for _ in range(2))
        c = self.constants
        numbers = [
            c.substep / self.parts, *c.gravity, c.friction, 0.5 * c.volume ** (1 / 3), c.spacing, self.time,
        ]  # fmt: skip
        self.numbers = self._array(torch.tensor(numbers, dtype=torch.float64))
        force = self.effects.force
        none = torch.zeros(self.count, 3, dtype=torch.float64)
        self.forces = self._array(none if force is None else force)
        self.masses = self._array(self.mass)
        graph = self.graph
        self.offsets, self.others = (self._array(a, ti.i32) for a in (graph.offsets, graph.others))
        self.bonds = [self._array(a) for a in (graph.lengths, self.stiffness, self.damping)]
        self.particle_effects = [
            (_particle_effect(effect, values.shape[-1]), self._array(values))
            for effect, values in zip(self.members, self.effects.coefficients, strict=True)
        ]

    def _array(self, values: torch.Tensor | np.ndarray, dtype: Any = None) -> Any:
        found = values.detach().numpy() if isinstance(values, torch.Tensor) else values
        if dtype is None:
            found = found.astype(np.float64 if self.dtype == torch.float64 else np.float32)
        array = self.ti.ndarray(dtype or self.real, found.shape)
        array.from_numpy(np.ascontiguousarray(found))
        return array

    def _simulate(self, segment: int) -> None:
        """Fill the arrays with the states of a segment. Raises NonFiniteError."""
        springs = _kernels()
        start, length, state = self.segments[segment]
        self.held = segment
        for array, values in zip((self.x, self.v), state, strict=True):
            springs.write_row(array, 0, values)
        network = (self.offsets, self.others, *self.bonds, self.forces, self.masses)
        contact, bad = self.constants.contact, -1
        if self.serial and not self.particle_effects:
            bad = springs.advance(0, length, self.x, self.v, *network, contact, self.numbers)
        else:
            for s in range(length):
                springs.accelerate(s, self.x, self.v, *network, self.numbers)
                if self.particle_effects:
                    self.numbers[springs.TIME] = self.time + (start + s) * self.constants.substep / self.parts
                for effect, values in self.particle_effects:
                    effect.apply(s, self.x, self.v, contact, values, self.numbers)
                bad = springs.touch_and_move(s, self.x, self.v, contact, self.numbers)
                if bad >= 0:
                    break
        if bad >= 0:
            step = (start + bad // self.count) // self.parts
            raise NonFiniteError(step, bad % self.count, "its velocity is not finite")

    # ---- backward --------------------------------------------------------------------------------------------------

    def backward(self, positions_bar: torch.Tensor) -> Adjoint:
        """Adjoints of the inputs from that of ``positions``, (K, N, 3). Raises MasivError with an effect on the
        particles' velocities."""
        if self.members:
            raise MasivError(f"springs have no adjoint with {self.members[0].name}: fit by finite differences")
        springs = _kernels()
        zeros = np.zeros((self.count, 3))
        x_bar, v_bar, f_bar, force_bar = (self._array(zeros) for _ in range(4))
        mass_bar = self._array(zeros[:, 0])
        stiffness_bar, damping_bar = (self._array(np.zeros(len(self.graph.others))) for _ in range(2))
        network = (self.offsets, self.others, *self.bonds)
        bars = positions_bar.detach().to(self.dtype).contiguous()
        for segment in reversed(range(len(self.segments))):
            start, length, _ = self.segments[segment]
            if self.held != segment:
                self._simulate(segment)
            seen = [s for s in range(length) if (start + s) % self.parts == 0]
            ends = [s for s in seen if (start + s) // self.parts in self.outputs]
            end = length
            if segment == len(self.segments) - 1:
                self._add(x_bar, bars, self.steps)
            for s in reversed(ends if 0 in ends else [0, *ends]):
                inputs = (self.x, self.v, *network, self.forces, self.masses, self.constants.contact, self.numbers)
                outputs = (x_bar, v_bar, f_bar, force_bar, mass_bar)
                if self.serial:
                    springs.advance_adjoint(s, end, *inputs, *outputs, stiffness_bar, damping_bar)
                else:
                    for one in reversed(range(s, end)):
                        springs.state_adjoint(one, *inputs, *outputs)
                        springs.bond_adjoint(
                            one, self.x, self.v, *network, x_bar, v_bar, f_bar, stiffness_bar, damping_bar
                        )  # fmt: skip
                if s in ends:
                    self._add(x_bar, bars, (start + s) // self.parts)
                end = s
        nothing = torch.zeros(self.count, 3, 3, dtype=self.dtype)
        x, v, force, mass = (self._tensor(a) for a in (x_bar, v_bar, force_bar, mass_bar))
        return Adjoint(
            State(x, v, nothing, nothing), self._law_gradients(stiffness_bar, damping_bar), [], mass,
            None if self.effects.force is None else force,
        )  # fmt: skip

    def _add(self, x_bar: Any, bars: torch.Tensor, step: int) -> None:
        row = self.outputs.get(step)
        if row is not None:
            _kernels().add(x_bar, bars[row])

    def _tensor(self, array: Any) -> torch.Tensor:
        return torch.from_numpy(array.to_numpy())

    def _law_gradients(self, stiffness_bar: Any, damping_bar: Any) -> tuple[torch.Tensor | None, ...]:
        bars = [self._tensor(b).double() for b in (stiffness_bar, damping_bar)]
        used = [(o, b) for o, b in zip((self.stiffness, self.damping), bars, strict=True) if o.requires_grad]
        parameters = list(self.law.parameters())
        wanted = [p for p in parameters if p.requires_grad]
        if not used or not wanted:
            return tuple(None for _ in parameters)
        found = iter(torch.autograd.grad([o for o, _ in used], wanted, [b for _, b in used], allow_unused=True))
        return tuple(next(found) if p.requires_grad else None for p in parameters)


def rest_of(state: State) -> torch.Tensor:
    """Positions (N, 3) [m] at which no spring is strained. Raises InputError for a deformed state that does not know
    them."""
    if state.rest_position is not None:
        return state.rest_position
    eye = torch.eye(3, dtype=state.trial_gradient.dtype)
    if (state.trial_gradient - eye).abs().max() > 1e-6:
        raise InputError("law springs: the initial state is deformed, and its positions at rest are not known")
    return state.position


def _kernels() -> Any:
    from masiv.kernels import springs

    return springs


@functools.lru_cache(maxsize=32)
def _particle_effect(effect: NodalEffect | ContactEffect, coefficients: int) -> Any:
    on_ground = isinstance(effect, ContactEffect)
    function = effect.contact_velocity() if on_ground else effect.node_velocity()
    return _kernels().ParticleEffect(function, coefficients, on_ground)
