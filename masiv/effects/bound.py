"""The kernels of a rollout's effects, and their adjoints."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import searched_causes
from masiv.effects.context import EffectContext
from masiv.effects.effect import ContactEffect, Effect, HistoryEffect, NodalEffect, StressEffect
from masiv.errors import MasivError

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels
    from masiv.materials.law import BoundLaw

KernelEffect = NodalEffect | ContactEffect | StressEffect
ALLOCATED_TOGETHER = 4
"""Effects whose fields are allocated at once: Taichi takes 1024 components of fields at a time, and the adjoint of one
has up to about 120."""


class BoundEffects:
    """The effects of one rollout on the fields of a simulator.

    Inputs of the rollout that effects give, differentiable: coefficients, one tensor for each of
    ``ActiveEffects.kernel_members``; force (N, 3) [N] on the particles, None if there is none; mass_factor (N,), None
    if masses are as they are. forward: ``ForwardEffects``, or ``NoEffects`` if nothing acts in a substep.
    """

    def __init__(self, effects: ActiveEffects | None, mpm: MpmKernels, count: int) -> None:
        self.mpm = mpm
        self.count = count
        self.members: list[KernelEffect] = [e for e, _ in effects.kernel_members] if effects else []
        self.coefficients = effects.coefficients() if effects else []
        self.force = effects.force() if effects else None
        self.mass_factor = effects.mass_factor() if effects else None
        self.suspended = effects.suspended_mass() if effects else None
        self._values = [c.detach().to(mpm.torch_dtype).contiguous() for c in self.coefficients]
        self._force_values = None if self.force is None else self.force.detach().to(mpm.torch_dtype).contiguous()
        self.on_grid = any(not isinstance(e, StressEffect) for e in self.members)
        self.on_stress = any(isinstance(e, StressEffect) for e in self.members)
        self.empty = not self.members and self.force is None and self.suspended is None
        self._internal = None
        for effect, values in zip(self.members, self._values, strict=True):
            if isinstance(effect, HistoryEffect):
                self._internal = _internal_variables(mpm, effect, values.shape[-1])
        self._known: list[KernelEffect] = []
        if effects is None or self.empty:
            from masiv.kernels.forward_effects import no_effects

            self.forward: Any = no_effects(mpm)
        else:
            self._known = _compiled_together(self.members)
            self.forward = _forward_effects(mpm, self._known, effects.context, suspends=self.suspended is not None)

    def write(self) -> None:
        """Fill the fields of the forward substep, which rollouts of one capacity share."""
        if not self.empty:
            values = zip(self.members, self._values, strict=True)
            self.forward.write({self._known.index(e): c for e, c in values}, self._force_values)
        if self.suspended is not None:
            kernels = self.forward.suspension
            kernels.load[None], kernels.length[None] = self.suspended.mass, self.suspended.length
            kernels.write_weights(self.suspended.weights.detach().to(self.mpm.torch_dtype).contiguous())

    def write_internal(self, values: torch.Tensor | None, first: bool) -> None:
        """Internal variables (N, K) before local substep 0, None if none are known. first: of the rollout, too."""
        if self._internal is not None:
            self._internal.started[None] = 0 if first and values is None else 1
            if values is None:
                self._internal.clear(self.count)
            else:
                self._internal.write(values)

    def read_internal(self, s: int) -> torch.Tensor | None:
        """Internal variables (N, K) before local substep s; None if no effect has any."""
        if self._internal is None:
            return None
        internal = self._internal
        out = torch.empty(self.count, internal.branches * internal.size, dtype=self.mpm.torch_dtype)
        self._internal.read(s, out)
        return out

    def write_suspended(self, state: torch.Tensor | None) -> None:
        """Place and velocity (2, 3) of the suspended mass before local substep 0; None: it hangs at rest."""
        if self.suspended is not None and state is None:
            self.forward.suspension.hang(self.count)
        elif self.suspended is not None and state is not None:
            kernels, (place, velocity) = self.forward.suspension, state.tolist()
            kernels.place[0], kernels.velocity[0] = place, velocity

    def read_suspended(self, s: int) -> torch.Tensor | None:
        """Place and velocity (2, 3) [m, m/s] of the suspended mass before local substep s; None if there is none."""
        if self.suspended is None:
            return None
        kernels = self.forward.suspension
        rows = [list(kernels.place[s]), list(kernels.velocity[s])]
        return torch.tensor(rows, dtype=self.mpm.torch_dtype)

    # ---- a substep in several launches -----------------------------------------------------------------------------

    def p2g(self, law: BoundLaw, s: int, nodes: int) -> None:
        """Law, effects on the stress, transfer to the grid."""
        if not self.on_stress:
            law.p2g(self.mpm, s, self.count, nodes)
            return
        law.forward(s, self.count)
        self.forward.on_stress(s, self.count)
        self.mpm.p2g(s, self.count, nodes)

    def grid_update(self, offset: int, nodes: int, time: float) -> None:
        """Sum of the chunks' grids into the log at ``offset``; velocities of the nodes: gravity, effects, contact."""
        if self.on_grid:
            self.forward.grid_update(offset, nodes, time)
        else:
            self.mpm.grid_update(offset, nodes)

    def apply_forces(self, s: int) -> None:
        """Forces on the particles, and the suspended mass, at the end of substep s."""
        if self.force is not None:
            self.forward.on_velocities(s + 1, self.count)
        if self.suspended is not None:
            self.forward.suspension.step(s + 1, self.count)

    # ---- its adjoint, in the reverse order -------------------------------------------------------------------------

    @cached_property
    def adjoint(self) -> BoundAdjoints:
        """Kernels of the adjoint, with fields of their own: made if one is asked for. Raises MasivError for a suspended
        mass."""
        if self.suspended is not None:
            raise MasivError("a rollout with a suspended mass has no gradient: fit by finite differences")
        return BoundAdjoints(self.mpm, self.count, self.members, self._values, self._force_values)


class BoundAdjoints:
    """Adjoints of what the effects ``members``, with coefficients ``values``, and a ``force`` (N, 3) [N] do in a
    substep."""

    def __init__(
        self,
        mpm: MpmKernels,
        count: int,
        members: list[KernelEffect],
        values: list[torch.Tensor],
        force: torch.Tensor | None,
    ) -> None:
        self.mpm = mpm
        self.count = count
        self._values, self._force_values = values, force
        self._kernels = []
        for index, (effect, c) in enumerate(zip(members, values, strict=True)):
            if index and index % ALLOCATED_TOGETHER == 0:
                mpm.allocate()
            self._kernels.append(_kernels(mpm, effect, c.shape[-1]))
        by_kind = list(zip(self._kernels, members, strict=True))
        self.nodes = [k for k, e in by_kind if isinstance(e, NodalEffect)]
        self.contact = [k for k, e in by_kind if isinstance(e, ContactEffect)]
        self.stress = [k for k, e in by_kind if isinstance(e, StressEffect)]
        self.on_grid = bool(self.nodes or self.contact)
        if self.on_grid:
            from masiv.kernels.effects import OpenGrid

            self._grid = mpm.attached(OpenGrid, lambda: OpenGrid(mpm))
        self._force_kernels = None
        if force is not None:
            from masiv.kernels.effects import ForceKernels

            self._force_kernels = mpm.attached(ForceKernels, lambda: ForceKernels(mpm))

    def write(self) -> None:
        """Fill the fields, which rollouts of one capacity share, and set the sums of gradients to zero."""
        for kernels, values in zip(self._kernels, self._values, strict=True):
            kernels.write(values)
        if self._force_kernels is not None:
            self._force_kernels.write(self._force_values)

    def apply_forces(self, s: int) -> None:
        """Adjoint of forces on the particles; the change of the state is undone."""
        if self._force_kernels is not None:
            self._force_kernels.adjoint(s + 1, self.count)

    def restore_grid(self, s: int, offset: int, nodes: int, time: float) -> None:
        """Velocities of the nodes in substep s, from the log at ``offset``; offset 0: its grid is not in the log."""
        if not offset:
            self.mpm.p2g(s, self.count, nodes)
            self.mpm.grid_update(offset, nodes)
        elif not self.on_grid:
            self.mpm.grid_velocities(offset, nodes)
        if self.on_grid:
            self._grid.free(offset, nodes)
            for kernels in (*self.nodes, *self.contact):
                kernels.apply(nodes, time)
            if not self.contact:
                self._grid.contact(nodes)

    def grid_update(self, offset: int, nodes: int, time: float) -> None:
        """What ``g2p_adjoint`` scattered -> ``grid_momentum_bar``, after ``restore_grid`` of the same substep."""
        if not self.on_grid:
            self.mpm.grid_adjoint(offset, nodes)
            return
        self._grid.sum_bars(nodes)
        if not self.contact:
            self._grid.contact_adjoint(nodes)
        for kernels in reversed((*self.nodes, *self.contact)):
            kernels.adjoint(nodes, time)
        self._grid.momentum_adjoint(offset, nodes)

    def p2g(self, law: BoundLaw, s: int) -> None:
        """``grid_momentum_bar`` -> adjoints of the particles before substep s."""
        self.mpm.p2g_adjoint(s, self.count)
        if self.stress:
            law.forward(s, self.count)
            for kernels in self.stress:
                kernels.apply(s, self.count)
            for kernels in reversed(self.stress):
                kernels.adjoint(s, self.count)
        law.backward(s, self.count)

    # ---- gradients since ``write`` ---------------------------------------------------------------------------------

    def coefficient_gradients(self) -> list[torch.Tensor]:
        """Adjoints of ``coefficients``."""
        out = [torch.empty_like(values) for values in self._values]
        for kernels, gradient in zip(self._kernels, out, strict=True):
            kernels.read_gradient(gradient)
        return out

    def force_gradient(self) -> torch.Tensor | None:
        """Adjoint (N, 3) of ``force``."""
        if self._force_kernels is None or self._force_values is None:
            return None
        out = torch.empty_like(self._force_values)
        self._force_kernels.read_gradient(out)
        return out


def _compiled_together(members: list[KernelEffect]) -> list[KernelEffect]:
    """Effects of the kernel that simulates ``members``: all that a search considers by default, so that one kernel
    serves them all; ``members`` alone if others are among them. In the order of ``ForwardEffects``, in which
    ``members`` are."""
    kinds = (NodalEffect, ContactEffect, StressEffect)
    library = [e for kind in kinds for e in searched_causes().values() if isinstance(e, kind)]
    return library if all(e in library for e in members) else members


def _forward_effects(mpm: MpmKernels, effects: list[KernelEffect], context: EffectContext, *, suspends: bool) -> Any:
    from masiv.kernels.forward_effects import ForwardEffects
    from masiv.kernels.suspension import SuspensionKernels

    def make() -> Any:
        nodal = [(e.node_velocity(), _size(e, context)) for e in effects if isinstance(e, NodalEffect)]
        contact = [(e.contact_velocity(), _size(e, context)) for e in effects if isinstance(e, ContactEffect)]
        stress = []
        for e in effects:
            if isinstance(e, StressEffect):
                size = _size(e, context)
                internal = _internal_variables(mpm, e, size) if isinstance(e, HistoryEffect) else None
                stress.append((e.particle_stress(), size, internal))
        suspension = mpm.attached(SuspensionKernels, lambda: SuspensionKernels(mpm)) if suspends else None
        return ForwardEffects(mpm, nodal, contact, stress, suspension)

    return mpm.attached((ForwardEffects, tuple(effects), suspends), make)


def _internal_variables(mpm: MpmKernels, effect: HistoryEffect, coefficients: int) -> Any:
    """coefficients: of all branches."""
    from masiv.kernels.internal_variables import InternalVariables

    sizes = (effect.branches, effect.internal_variables, coefficients // effect.branches)
    return mpm.attached((InternalVariables, *sizes), lambda: InternalVariables(mpm, *sizes))


def _size(effect: KernelEffect, context: EffectContext) -> int:
    """Coefficients of its Taichi function."""
    start = torch.tensor([p.start for p in effect.parameters], dtype=context.rest.dtype)
    return effect.coefficients(start, context).shape[-1]


def _kernels(mpm: MpmKernels, effect: Effect, coefficients: int) -> Any:
    from masiv.kernels.effects import HistoryKernels, NodeKernels, StressKernels

    def make() -> Any:
        if isinstance(effect, HistoryEffect):
            internal = _internal_variables(mpm, effect, coefficients)
            return HistoryKernels(mpm, effect.particle_stress(), internal)
        if isinstance(effect, StressEffect):
            return StressKernels(mpm, effect.particle_stress(), coefficients)
        if isinstance(effect, NodalEffect):
            return NodeKernels(mpm, effect.node_velocity(), coefficients, grounded=False)
        assert isinstance(effect, ContactEffect)
        return NodeKernels(mpm, effect.contact_velocity(), coefficients, grounded=True)

    return mpm.attached((effect, coefficients), make)
