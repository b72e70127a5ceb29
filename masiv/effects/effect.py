"""The interface of every effect: physics that the model may lack, zero in the model as it is."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect. ``step`` is a change that a video of an object of half a metre can just show (about 1 mm);
    ``lower`` and ``upper`` are what is physically possible; ``start`` where a search begins (a strength begins at 0).

    Vectors and places are in the simulation frame: y is up, and the ground that the model has is at y = 0."""

    name: str
    unit: str
    lower: float
    upper: float
    step: float
    start: float = 0.0


@dataclass(frozen=True)
class EffectContext:
    """What an effect may know of the scene, simulation frame (y up, ground at y = 0), SI units: gravity (3,), positions
    ``rest`` (N, 3) and mass of the particles at frame 0, size of the body, how long it is watched [s], the time between
    two frames [s], and ``path`` (T, M, 3), where some of its points were seen (None: not known)."""

    gravity: torch.Tensor
    rest: torch.Tensor
    particle_mass: float
    size: float
    duration: float
    frame_time: float = 1 / 24
    path: torch.Tensor | None = None


@dataclass(frozen=True)
class DragBody:
    """A body as the medium that it moves through sees it: diameter [m], mass [kg]; density [kg/m^3] and viscosity
    [Pa s] of the medium."""

    diameter: float
    mass: float
    medium_density: float
    medium_viscosity: float


class Effect(ABC):
    """One effect; a subclass a file in ``masiv/effects``, found there by ``masiv.effects.catalogue``.

    A subclass sets ``name``, ``looks_like`` (what it does in a video, one line), ``parameters`` (the first ones, as
    many as ``strengths``, are the strength: where they are zero the effect is absent) and overrides one or more hooks.
    """

    name: ClassVar[str]
    looks_like: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    strengths: ClassVar[int] = 1
    on_grid: ClassVar[str | None] = None
    """``nodes``: ``node_velocity`` acts everywhere, before contact; ``ground``: it is the contact with the ground."""
    nonsmooth: ClassVar[bool] = False
    """Whether it sets in at some strength, or all at once, so that a derivative at none may say nothing of it."""
    on_stress: ClassVar[bool] = False
    cause: ClassVar[bool] = True
    """False for a stop-gap, which no search may name."""
    needs_clamp: ClassVar[bool] = False
    """Whether it acts on a body that is held somewhere: on a free one it is nothing but another effect."""

    inside: ClassVar[bool] = False
    """Whether its place is in the body: it acts on the matter that is there."""
    replaces_parameter: ClassVar[str | None] = None
    """What of every throw is fitted for want of this effect, and no longer beside it."""

    per_body: ClassVar[bool] = False
    """Whether the strength depends on the body (a drag), so that bodies may differ; else it is that of the
    surroundings, one for all that move in them."""
    shared: ClassVar[tuple[EffectParameter, ...] | None] = None
    """The strength as bodies of different size and mass may share it, see ``of``; None: as it is."""

    def of(self, theta: torch.Tensor, body: DragBody) -> torch.Tensor:
        """Values of ``shared`` (P,) -> the parameters of ``body`` (P,)."""
        return theta

    def violates_bounds(self, theta: torch.Tensor, body: DragBody) -> str | None:
        """Why values of ``shared`` (P,) cannot be, given what is known of the body and the medium."""
        return None

    def identifiability_issue(self, theta: torch.Tensor, watched: float, places: torch.Tensor) -> str | None:
        """Why parameters (P,) do not deserve the effect's name after ``watched`` seconds of motion in which points of
        the body came through ``places`` (M, 3) [m], or None."""
        return None

    def node_velocity(self) -> Callable[..., Any]:
        """Taichi function (x, v, held, t, dt, dx, c) -> v, see ``masiv.kernels.effects.NodeKernels``. For those
        with ``on_grid``."""
        raise TypeError(f"{self.name} does not act on the grid")

    def particle_stress(self) -> Callable[..., Any]:
        """Taichi function (tau, F, C, c) -> tau, see ``masiv.kernels.effects.StressKernels``. For those with
        ``on_stress``."""
        raise TypeError(f"{self.name} does not act on the stress")

    def coefficients(self, theta: torch.Tensor, setting: EffectContext) -> torch.Tensor:
        """Parameters (P,) -> c, shape (K,) for an effect on the grid, (N, K) for one on the stress; differentiable."""
        return theta.expand(len(setting.rest), -1) if self.on_stress else theta

    def mass_factor(self, theta: torch.Tensor, setting: EffectContext) -> torch.Tensor | None:
        """Factor (N,) of the particles' masses, or None where the effect leaves masses alone."""
        return None

    def force(self, theta: torch.Tensor, setting: EffectContext) -> torch.Tensor | None:
        """Force (N, 3) [N] on each particle, the same at all times, or None."""
        return None

    def ground_shift(self, theta: torch.Tensor) -> torch.Tensor | None:
        """How far () [m] the effect raises the ground, or None."""
        return None

    def time_shift(self, theta: torch.Tensor) -> torch.Tensor | None:
        """How much later () [s] than its time stamp a frame was taken, or None."""
        return None

    def guesses(self, setting: EffectContext) -> list[tuple[float, ...]]:
        """Values of the parameters after the strengths to try in the score test, each a tuple."""
        return [tuple(p.start for p in self.parameters[self.strengths :])]
