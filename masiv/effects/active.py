"""Effects attached to a rollout: the order in which they act, and their adjoint."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from masiv.effects.effect import Effect, EffectContext
from masiv.errors import InputError

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels
    from masiv.materials.law import BoundLaw


@dataclass(frozen=True)
class ActiveEffects:
    """Effects with the values (P,) of their parameters. Raises InputError for two that both replace the contact."""

    members: tuple[tuple[Effect, torch.Tensor], ...]
    setting: EffectContext

    def __post_init__(self) -> None:
        on_ground = [effect.name for effect, _ in self.members if effect.on_grid == "ground"]
        if len(on_ground) > 1:
            raise InputError(f"{' and '.join(on_ground)} both replace the contact with the ground: use one of them")

    @property
    def kernel_members(self) -> list[tuple[Effect, torch.Tensor]]:
        """Those with kernels: the nodes' effects, then the ground's, then those on the stress."""
        order = [e for e in self.members if e[0].on_grid == "nodes"]
        order += [e for e in self.members if e[0].on_grid == "ground"]
        return order + [e for e in self.members if e[0].on_stress]

    def coefficients(self) -> list[torch.Tensor]:
        """Coefficients of ``kernel_members``, differentiable."""
        return [effect.coefficients(theta, self.setting) for effect, theta in self.kernel_members]

    def mass_factor(self) -> torch.Tensor | None:
        """Product (N,) of the factors of mass, or None where no effect has one."""
        return _product(effect.mass_factor(theta, self.setting) for effect, theta in self.members)

    def force(self) -> torch.Tensor | None:
        """Sum (N, 3) [N] of the forces on the particles, or None where no effect has one."""
        forces = [f for effect, theta in self.members if (f := effect.force(theta, self.setting)) is not None]
        return functools.reduce(torch.add, forces) if forces else None

    def ground_shift(self) -> torch.Tensor:
        """How far () [m] the ground is raised."""
        return _sum(effect.ground_shift(theta) for effect, theta in self.members)

    def time_shift(self) -> torch.Tensor:
        """How much later () [s] than their time stamps frames were taken."""
        return _sum(effect.time_shift(theta) for effect, theta in self.members)


def _product(factors) -> torch.Tensor | None:
    known = [f for f in factors if f is not None]
    return functools.reduce(torch.mul, known) if known else None


def _sum(terms) -> torch.Tensor:
    return sum((t for t in terms if t is not None), torch.zeros(()))


@functools.lru_cache(maxsize=64)
def _kernels(mpm, effect: Effect, coefficients: int):
    from masiv.kernels.effects import NodeKernels, StressKernels

    if effect.on_stress:
        return StressKernels(mpm, effect.particle_stress(), coefficients)
    return NodeKernels(mpm, effect.node_velocity(), coefficients, effect.on_grid == "ground")


@functools.lru_cache(maxsize=8)
def _force_kernels(mpm):
    from masiv.kernels.effects import ForceKernels

    return ForceKernels(mpm)


@functools.lru_cache(maxsize=8)
def _open_grid(mpm):
    from masiv.kernels.effects import OpenGrid

    return OpenGrid(mpm)


@functools.lru_cache(maxsize=64)
def _grid_with(mpm, members: tuple):
    from masiv.kernels.effects import GridWithEffects

    return GridWithEffects(mpm, members)


class BoundEffects:
    """The kernels of one rollout's effects."""

    def __init__(
        self,
        members: Sequence[tuple[Effect, torch.Tensor]],
        mpm: MpmKernels,
        count: int,
        force: torch.Tensor | None = None,
    ) -> None:
        """members: each with its coefficients (K,) or (N, K), in the order of ``ActiveEffects.kernel_members``; force
        (N, 3) [N] on the particles."""
        self.mpm = mpm
        self.count = count
        self.dtype = torch.float64 if "f64" in str(mpm.real) else torch.float32
        self.values = [c.detach().to(self.dtype).contiguous() for _, c in members]
        self.kernels = [_kernels(mpm, effect, c.shape[-1]) for effect, c in members]
        self.nodes = [k for k, (e, _) in zip(self.kernels, members, strict=True) if e.on_grid == "nodes"]
        self.ground = [k for k, (e, _) in zip(self.kernels, members, strict=True) if e.on_grid == "ground"]
        self.stress = [k for k, (e, _) in zip(self.kernels, members, strict=True) if e.on_stress]
        self.on_grid = bool(self.nodes or self.ground)
        self.grid = _open_grid(mpm) if self.on_grid else None
        self.whole_grid = _grid_with(mpm, (*self.nodes, *self.ground)) if self.on_grid else None
        self.force = None if force is None else force.detach().to(self.dtype).contiguous()
        self.push = None if force is None else _force_kernels(mpm)

    @property
    def none(self) -> bool:
        """Whether nothing acts in a substep."""
        return not self.kernels and self.push is None

    def write(self) -> None:
        """Fill the fields, which rollouts of one capacity share, and start the sums of gradients at zero."""
        for kernels, values in zip(self.kernels, self.values, strict=True):
            kernels.write(values)
        if self.push is not None:
            self.push.write(self.force)

    def after(self, s: int) -> None:
        """What acts on the particles, when substep s has ended."""
        if self.push is not None:
            self.push.apply(s + 1, self.count)

    def after_adjoint(self, s: int) -> None:
        """Adjoint of ``after``; the state that it made is undone."""
        if self.push is not None:
            self.push.adjoint(s + 1, self.count)

    def force_gradient(self) -> torch.Tensor | None:
        """Adjoint (N, 3) of the force since ``write``."""
        if self.push is None:
            return None
        out = torch.empty_like(self.force)
        self.push.read_gradient(out)
        return out

    def p2g(self, law: BoundLaw, s: int, nodes: int) -> None:
        """Law, effects on the stress, transfer to the grid."""
        if not self.stress:
            law.p2g(self.mpm, s, self.count, nodes)
            return
        law.forward(s, self.count)
        for kernels in self.stress:
            kernels.apply(s, self.count)
        self.mpm.p2g(s, self.count, nodes)

    def grid_update(self, offset: int, time: float) -> None:
        """The chunks' grids into the log at ``offset``, and velocities of the nodes: gravity, effects, contact."""
        if self.on_grid:
            self.whole_grid.grid_update(offset, time)
        else:
            self.mpm.grid_update(offset)

    def grid_velocities(self, offset: int, nodes: int, time: float) -> None:
        """Velocities of the nodes from the log at ``offset``, and what ``grid_adjoint`` needs of them."""
        if not self.on_grid:
            return
        self.grid.free(offset, nodes)
        for kernels in self.nodes:
            kernels.apply(nodes, time)
        for kernels in self.ground:
            kernels.apply(nodes, time)
        if not self.ground:
            self.grid.contact(nodes)

    def grid_adjoint(self, offset: int, nodes: int, time: float) -> None:
        """What ``g2p_adjoint`` scattered -> ``grid_momentum_bar``, after ``grid_velocities`` of the same substep."""
        self.grid.sum_bars(nodes)
        for kernels in self.ground:
            kernels.adjoint(nodes, time)
        if not self.ground:
            self.grid.contact_adjoint(nodes)
        for kernels in reversed(self.nodes):
            kernels.adjoint(nodes, time)
        self.grid.momentum_adjoint(offset, nodes)

    def stress_adjoint(self, law: BoundLaw, s: int) -> None:
        """``stress_bar`` after the effects -> that of the law's own stress."""
        if not self.stress:
            return
        law.forward(s, self.count)
        for kernels in self.stress:
            kernels.apply(s, self.count)
        for kernels in reversed(self.stress):
            kernels.adjoint(s, self.count)

    def gradients(self) -> list[torch.Tensor]:
        """Adjoints of the coefficients since ``write``."""
        out = [torch.empty_like(values) for values in self.values]
        for kernels, gradient in zip(self.kernels, out, strict=True):
            kernels.read_gradient(gradient)
        return out
