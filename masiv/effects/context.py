"""What an effect declares of its parameters, and what it may know of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect, with the prior of a search.

    lower, upper: bounds of what is physically possible. step: the change that a video of an object of half a metre can
    just show (about 1 mm of motion). start: where a search begins; a strength begins at 0.

    Vectors and places are in the simulation frame: y is up, and the ground of the model is at y = 0.
    """

    name: str
    unit: str
    lower: float
    upper: float
    step: float
    start: float = 0.0


@dataclass(frozen=True)
class EffectContext:
    """What an effect may know of the scene; simulation frame (y up, ground at y = 0), SI units.

    gravity (3,); rest (N, 3): positions of the particles at frame 0; particle_mass [kg] of one particle; size [m] of
    the body; duration [s] of the observation; frame_time [s] between two frames; path (T, M, 3): observed positions of
    some points of the body, None if they are not known.
    """

    gravity: torch.Tensor
    rest: torch.Tensor
    particle_mass: float
    size: float
    duration: float
    frame_time: float = 1 / 24
    path: torch.Tensor | None = None
