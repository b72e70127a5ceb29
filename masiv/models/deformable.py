"""A deformable body in the simulator: its particles, what acts on it, its substep."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from masiv.effects.active import ActiveEffects
from masiv.effects.boundary.clamp import with_clamp
from masiv.effects.context import EffectContext
from masiv.effects.effect import Effect
from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.materials.law import Law
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import DIFFERENCE_MARGIN, HELD_MARGIN, NO_DEMAND, grid_spacing, substeps_per_frame
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.observations.identity import content_hash
from masiv.scene.transforms import SimulationFrame


@dataclass(frozen=True)
class HeldRegion:
    """The intersection of half-spaces n · x ≤ h: normals (P, 3), heights (P,) [m]; simulation axes."""

    normals: torch.Tensor
    heights: torch.Tensor


def with_clamps(effects: ActiveEffects, clamps: Sequence[HeldRegion]) -> ActiveEffects:
    """``effects`` and after them a clamp of each region."""
    for clamp in clamps:
        effects = with_clamp(effects, clamp.normals, clamp.heights)
    return effects


@dataclass(frozen=True)
class DeformableBody:
    """A body at rest, free or clamped.

    particles (N, 3) [m, simulation axes]; volume [m³]; density [kg/m³]; size [m]: the length that effects take for that
    of the body; axes: world -> simulation; gravity (3,) [m/s², simulation axes]; speed [m/s]: the greatest that the
    substep allows for; clamps: what is held. max_substeps: states kept at once; a rollout is the same for any number.
    Raises ValueError for arrays of another shape.
    """

    particles: torch.Tensor
    volume: float
    density: float
    size: float
    axes: SimulationFrame
    gravity: np.ndarray
    config: SimulatorConfig
    speed: float
    clamps: tuple[HeldRegion, ...] = ()
    max_substeps: int = 1024

    def __post_init__(self) -> None:
        for name, shape in (("particles", (len(self.particles), 3)), ("gravity", (3,))):
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"a body's {name} has shape {found}, it must be {shape}")

    @property
    def count(self) -> int:
        """Number of particles N."""
        return len(self.particles)

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.density * self.volume

    @property
    def spacing(self) -> float:
        """Side of a grid cell [m]."""
        return grid_spacing(self.volume, self.count, self.config)

    @property
    def is_clamped(self) -> bool:
        """Whether a part of it is held."""
        return bool(self.clamps)

    @cached_property
    def digest(self) -> str:
        """Of everything that a rollout depends on."""
        matter = (self.particles, self.volume, self.density, self.size, self.axes, self.gravity)
        return content_hash((*matter, self.config.model_dump(), self.clamps))

    def context(self, duration: float, frame_time: float, path: torch.Tensor | None = None) -> EffectContext:
        """What effects may know of the body. duration [s] of the recording; path (T, M, 3) [m]: where its points were
        seen."""
        gravity = torch.as_tensor(self.gravity, dtype=self.particles.dtype)
        return EffectContext(
            gravity, self.particles, self.mass / self.count, self.size, duration, frame_time, path
        )  # fmt: skip

    def effects(self, members: Sequence[tuple[Effect, torch.Tensor]], context: EffectContext) -> ActiveEffects:
        """Effects with their parameters, and after them the clamps."""
        return with_clamps(ActiveEffects(tuple(members), context), self.clamps)

    def substeps(self, law: Law, interval: float, effects: ActiveEffects | None = None) -> int:
        """The fewest equal substeps in ``interval`` [s] that ``law`` with ``effects`` is stable with. Raises MasivError
        if those are too many."""
        return substeps_per_frame(
            spacing=self.spacing,
            wave_modulus=law.wave_modulus(),
            density=self.density,
            speed=self.speed,
            frame_time=interval,
            config=self.config,
            demand=NO_DEMAND if effects is None else effects.substep_demand(),
        )

    def simulator(self, substep: float, contact: str, dtype: torch.dtype) -> Simulator:
        """That of the body, with substeps of ``substep`` [s]. contact: with the ground, see ``Simulator``."""
        return Simulator(
            particle_count=self.count,
            spacing=self.spacing,
            substep=substep,
            volume=self.volume,
            density=self.density,
            gravity=self.gravity,
            contact=contact,
            dtype=dtype,
            memory_mb=self.config.memory_mb,
            max_substeps=self.max_substeps,
            grid_nodes=self.config.grid_nodes,
            chunks=self.config.chunks,
        )

    def rollout(
        self,
        law: Law,
        state: State,
        outputs: Sequence[int],
        *,
        substep: float,
        contact: str,
        effects: ActiveEffects | None = None,
    ) -> torch.Tensor:
        """Positions (K, N, 3) [m, simulation axes] after each of ``outputs`` (ascending, may repeat) substeps from
        ``state``; differentiable. contact: with the ground, see ``Simulator``. The numbers have the type of ``state``.

        Raises NonFiniteError, and ValueError for a state of another number of particles.
        """
        for name, tensor, shape in zip(
            ("position", "velocity", "affine_velocity", "trial_gradient"),
            state.tensors(), ((self.count, 3), (self.count, 3), (self.count, 3, 3), (self.count, 3, 3)), strict=True,
        ):  # fmt: skip
            if tuple(tensor.shape) != shape:
                raise ValueError(f"the state's {name} has shape {tuple(tensor.shape)}, it must be {shape}")
        simulator = self.simulator(substep, contact, state.position.dtype)
        wanted = sorted(set(outputs))
        positions = rollout(simulator, law, state, wanted[-1], wanted, effects)
        if len(wanted) == len(outputs):
            return positions
        row = {step: k for k, step in enumerate(wanted)}
        return positions[torch.tensor([row[step] for step in outputs])]


class HeldSubsteps:
    """The substep of the first law of each key, held for the laws after it.

    What a grid loses depends on the substep by millimetres, so that a jump of it would be mistaken for a derivative. A
    law that is stiffer than the held substep allows by more than ``HELD_MARGIN`` is refused, as one that diverges.

    What effects ask for in addition divides the held substep, see ``halved``.
    """

    def __init__(self) -> None:
        self._held: dict[Hashable, float] = {}

    def take(self, key: Hashable, needed: float, first: float | None = None) -> float:
        """The substep [s] to take for a law that is stable with ``needed`` [s]; ``first`` [s], ``needed`` if None, is
        held if nothing is yet. Raises NonFiniteError."""
        held = self._held.setdefault(key, needed if first is None else first)
        _refuse_if_too_long("the law", held, needed)
        return held

    def shorten(self, key: Hashable, needed: float) -> bool:
        """Hold ``needed`` [s] if a law that needs it has used more than half of the margin (in the logarithm); whether
        that changed what is held. A fit that ends there was stopped by the substep, not by the data."""
        held = self._held.get(key, needed)
        if needed * math.sqrt(HELD_MARGIN) >= held:
            return False
        self._held[key] = needed
        return True

    def clear(self) -> None:
        """Hold nothing."""
        self._held.clear()


def halved(held: float, needed: float, shortest: float) -> float:
    """The substep [s] for effects that need ``needed`` [s] where the law alone is simulated with ``held`` [s].

    It is ``held`` as long as its margin is enough: an effect that is weak is compared with its absence on equal terms.
    Else it is that over the smallest power of two that is enough, not below ``shortest`` [s], which the configuration
    allows: a strength at which it changes is rare, and the motion is a function of a model's values alone, whatever was
    simulated before and in whichever process. Derivatives are taken at the substep of the point that they are for, see
    ``ForwardModel.held_at``.
    """
    if needed * HELD_MARGIN >= held * (1 - 1e-9):
        return held
    halvings = math.ceil(math.log2(held / needed) - 1e-9)
    return min(held, max(held / 2**halvings, shortest))


def check_substep(taken: float, needed: float) -> None:
    """Raises NonFiniteError if ``taken`` [s], which is that of a point, is longer than ``needed`` [s] a finite
    difference away by more than ``HELD_MARGIN`` and ``DIFFERENCE_MARGIN``."""
    _refuse_if_too_long("the law with its effects", taken, DIFFERENCE_MARGIN * needed)


def _refuse_if_too_long(what: str, taken: float, needed: float) -> None:
    if needed * HELD_MARGIN < taken * (1 - 1e-9):
        raise NonFiniteError(0, 0, f"{what} needs substeps of {needed:.3g} s, {taken:.3g} s are taken")


@contextmanager
def failures_as_divergence() -> Iterator[None]:
    """A law that cannot be simulated (too many substeps, a body that spreads without bound) counts as one that
    diverges: MasivError becomes NonFiniteError, from which fits step back. InputError stays."""
    try:
        yield
    except (InputError, NonFiniteError):
        raise
    except MasivError as failed:
        raise NonFiniteError(0, 0, str(failed)) from failed


def checked_instants(times: np.ndarray) -> np.ndarray:
    """``times`` (T,) [s]. Raises InputError unless they ascend from 0 or later to more than 0."""
    if times.ndim != 1 or times[0] < 0 or not times[-1] > 0 or (np.diff(times) < 0).any():
        raise InputError("a simulation runs from the release on: give times from 0 s, such as those of run.moving()")
    return times
