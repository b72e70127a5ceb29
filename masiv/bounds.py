"""Bounds beyond which a number cannot be of a body that masiv simulates: a wrong unit or a typing error. SI units.

Each has a reason from physics; none is a limit of the method. Light: no torch, no taichi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from masiv.errors import InputError


@dataclass(frozen=True)
class Bound:
    """lower ≤ value ≤ upper in ``unit``; ``reason`` says in half a sentence why nothing lies beyond."""

    name: str
    lower: float
    upper: float
    unit: str
    reason: str

    def check(self, value: float | np.ndarray, where: str) -> None:
        """Raises InputError for a number, or a vector by its length, that is not finite or lies outside. ``where``
        names the option, the key or the file."""
        size = float(np.linalg.norm(value)) if np.ndim(value) else float(value)
        if not (math.isfinite(size) and self.lower <= size <= self.upper):
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(
                f"{where}: {self.name} {size:.4g}{unit} is not between {self.lower:g} and {self.upper:g}{unit} "
                f"({self.reason}): check the number and its unit"
            )

    def field(self) -> object:
        """For an annotation of pydantic."""
        return Field(ge=self.lower, le=self.upper)


DENSITY = Bound("density", 1e-2, 3e4, "kg/m³", "hydrogen gas has 0.08, osmium 22600")
FPS = Bound(
    "frame rate", 1e-2, 1e8, "1/s",
    "in 100 s gravity moves a body by 49 km, and the fastest cameras of a motion take 10⁷ pictures a second",
)  # fmt: skip
SPEED = Bound("speed", 0, 1e4, "m/s", "a solid that hits anything at 10 km/s turns to vapour")
SPIN = Bound("spin", 0, 1e5, "rad/s", "the fastest centrifuges make 2·10⁴ rad/s, and bodies break")
ACCELERATION = Bound("acceleration", 0, 1e7, "m/s²", "the strongest centrifuges make 10⁶ g")
LENGTH = Bound("length", 0, 1e6, "m", "gravity is not one vector over a thousand kilometres")
SIZE = Bound("longest side", 1e-6, 100, "m", "a continuum is not smaller, and buildings are not larger")
VOLUME = Bound("volume", SIZE.lower**3, SIZE.upper**3, "m³", SIZE.reason)
MASS = Bound("mass", DENSITY.lower * VOLUME.lower, DENSITY.upper * VOLUME.upper, "kg", "as of density and volume")
FRICTION = Bound("coefficient of friction", 0, 10, "", "rubber on rubber has 1 to 4")
TIME = Bound("time", 0, 1e10, "s", "time stamps since 1970 are below 10¹⁰ s")
PRESSURE = Bound("modulus", 0, 1e13, "Pa", "diamond has 1.2·10¹² Pa")
VISCOSITY = Bound("viscosity", 0, 1e16, "Pa s", "ice of a glacier has 10¹³ Pa s, rock more")

Density = Annotated[float, DENSITY.field()]
Fps = Annotated[float, FPS.field()]
