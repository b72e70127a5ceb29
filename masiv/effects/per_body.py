"""How bodies of different size and mass share the strength of an effect."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from masiv.effects.context import EffectParameter


@dataclass(frozen=True)
class DragBody:
    """A body in a medium: diameter [m], mass [kg]; density [kg/m^3] and viscosity [Pa s] of the medium."""

    diameter: float
    mass: float
    medium_density: float
    medium_viscosity: float


class PerBody(ABC):
    """Maps what bodies share (a drag coefficient) to the parameters of one body (a rate)."""

    parameters: ClassVar[tuple[EffectParameter, ...]]
    """What is shared, in place of the effect's own parameters: as many, strengths first."""
    differs_by_body: ClassVar[bool]
    """True if it depends on the shape, so that bodies may differ; False if it belongs to the surroundings."""

    @abstractmethod
    def of_body(self, theta: torch.Tensor, body: DragBody) -> torch.Tensor:
        """Values of ``parameters`` (P,) -> the parameters of the effect on ``body`` (P,)."""

    def guesses(self) -> list[tuple[float, ...]] | None:
        """Values of ``parameters`` after the strengths that a search tries; None: those of the effect."""
        return None

    def violates_bounds(self, theta: torch.Tensor, body: DragBody) -> str | None:
        """Why values of ``parameters`` (P,) are impossible for this body and medium; None if they are possible."""
        return None
