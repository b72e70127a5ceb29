"""The kernels of a rollout's effects, and their adjoints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import ContactEffect, NodalEffect, StressEffect

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels
    from masiv.materials.law import BoundLaw


class BoundEffects:
    """The effects of one rollout on the fields of a simulator.

    Inputs of the rollout that effects give, differentiable: coefficients, one tensor for each of
    ``ActiveEffects.kernel_members``; force (N, 3) [N] on the particles, None if there is none; mass_factor (N,), None
    if masses are as they are.
    """

    def __init__(self, effects: ActiveEffects | None, mpm: MpmKernels, count: int) -> None:
        self.mpm = mpm
        self.count = count
        members = effects.kernel_members if effects else []
        self.coefficients = effects.coefficients() if effects else []
        self.force = effects.force() if effects else None
        self.mass_factor = effects.mass_factor() if effects else None
        self._values = [c.detach().to(mpm.torch_dtype).contiguous() for c in self.coefficients]
        self._kernels = [_kernels(mpm, e, c.shape[-1]) for (e, _), c in zip(members, self.coefficients, strict=True)]
        by_kind = list(zip(self._kernels, (e for e, _ in members), strict=True))
        self.nodes = [k for k, e in by_kind if isinstance(e, NodalEffect)]
        self.contact = [k for k, e in by_kind if isinstance(e, ContactEffect)]
        self.stress = [k for k, e in by_kind if isinstance(e, StressEffect)]
        self.on_grid = bool(self.nodes or self.contact)
        if self.on_grid:
            from masiv.kernels.effects import GridWithEffects, OpenGrid

            on_grid = (*self.nodes, *self.contact)
            self._grid = mpm.attached(OpenGrid, lambda: OpenGrid(mpm))
            self._whole_grid = mpm.attached((GridWithEffects, on_grid), lambda: GridWithEffects(mpm, on_grid))
        self._force_kernels = None
        if self.force is not None:
            from masiv.kernels.effects import ForceKernels

            self._force_kernels = mpm.attached(ForceKernels, lambda: ForceKernels(mpm))
            self._force_values = self.force.detach().to(mpm.torch_dtype).contiguous()

    @property
    def empty(self) -> bool:
        """True if nothing acts in a substep."""
        return not self._kernels and self._force_kernels is None

    def write(self) -> None:
        """Fill the fields, which rollouts of one capacity share, and set the sums of gradients to zero."""
        for kernels, values in zip(self._kernels, self._values, strict=True):
            kernels.write(values)
        if self._force_kernels is not None:
            self._force_kernels.write(self._force_values)

    # ---- a substep; ``*_adjoint`` are called in the reverse order --------------------------------------------------

    def p2g(self, law: BoundLaw, s: int, nodes: int) -> None:
        """Law, effects on the stress, transfer to the grid."""
        if not self.stress:
            law.p2g(self.mpm, s, self.count, nodes)
            return
        self._stress(law, s)
        self.mpm.p2g(s, self.count, nodes)

    def grid_update(self, offset: int, time: float) -> None:
        """Sum of the chunks' grids into the log at ``offset``; velocities of the nodes: gravity, effects, contact."""
        if self.on_grid:
            self._whole_grid.grid_update(offset, time)
        else:
            self.mpm.grid_update(offset)

    def apply_forces(self, s: int) -> None:
        """Forces on the particles at the end of substep s."""
        if self._force_kernels is not None:
            self._force_kernels.apply(s + 1, self.count)

    def apply_forces_adjoint(self, s: int) -> None:
        """Adjoint of ``apply_forces``; the change of the state is undone."""
        if self._force_kernels is not None:
            self._force_kernels.adjoint(s + 1, self.count)

    def restore_grid(self, s: int, offset: int, nodes: int, time: float) -> None:
        """Velocities of the nodes in substep s, from the log at ``offset``; offset 0: its grid is not in the log."""
        if not offset:
            self.mpm.p2g(s, self.count, nodes)
            self.mpm.grid_update(offset)
        elif not self.on_grid:
            self.mpm.grid_velocities(offset)
        if self.on_grid:
            self._grid.free(offset, nodes)
            for kernels in (*self.nodes, *self.contact):
                kernels.apply(nodes, time)
            if not self.contact:
                self._grid.contact(nodes)

    def grid_update_adjoint(self, offset: int, nodes: int, time: float) -> None:
        """What ``g2p_adjoint`` scattered -> ``grid_momentum_bar``, after ``restore_grid`` of the same substep."""
        if not self.on_grid:
            self.mpm.grid_adjoint(offset)
            return
        self._grid.sum_bars(nodes)
        if not self.contact:
            self._grid.contact_adjoint(nodes)
        for kernels in reversed((*self.nodes, *self.contact)):
            kernels.adjoint(nodes, time)
        self._grid.momentum_adjoint(offset, nodes)

    def p2g_adjoint(self, law: BoundLaw, s: int) -> None:
        """``grid_momentum_bar`` -> adjoints of the particles before substep s."""
        self.mpm.p2g_adjoint(s, self.count)
        if self.stress:
            self._stress(law, s)
            for kernels in reversed(self.stress):
                kernels.adjoint(s, self.count)
        law.backward(s, self.count)

    def _stress(self, law: BoundLaw, s: int) -> None:
        law.forward(s, self.count)
        for kernels in self.stress:
            kernels.apply(s, self.count)

    # ---- gradients since ``write`` ---------------------------------------------------------------------------------

    def coefficient_gradients(self) -> list[torch.Tensor]:
        """Adjoints of ``coefficients``."""
        out = [torch.empty_like(values) for values in self._values]
        for kernels, gradient in zip(self._kernels, out, strict=True):
            kernels.read_gradient(gradient)
        return out

    def force_gradient(self) -> torch.Tensor | None:
        """Adjoint (N, 3) of ``force``."""
        if self._force_kernels is None:
            return None
        out = torch.empty_like(self._force_values)
        self._force_kernels.read_gradient(out)
        return out


def _kernels(mpm: MpmKernels, effect: NodalEffect | ContactEffect | StressEffect, coefficients: int) -> Any:
    from masiv.kernels.effects import NodeKernels, StressKernels

    def make() -> Any:
        if isinstance(effect, StressEffect):
            return StressKernels(mpm, effect.particle_stress(), coefficients)
        if isinstance(effect, NodalEffect):
            return NodeKernels(mpm, effect.node_velocity(), coefficients, grounded=False)
        return NodeKernels(mpm, effect.contact_velocity(), coefficients, grounded=True)

    return mpm.attached((effect, coefficients), make)
