"""A number that is fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Parameter:
    """A number to fit. start, lower and upper in its own unit; ``step`` of the finite difference in the fitted scale,
    which is the natural logarithm where ``log``: step 0.05 is then 5 %."""

    name: str
    start: float
    lower: float
    upper: float
    step: float
    log: bool = False

    def __post_init__(self) -> None:
        if not self.lower <= self.start <= self.upper or self.lower >= self.upper:
            raise ValueError(f"parameter {self.name}: start {self.start} is not within [{self.lower}, {self.upper}]")
        if self.step <= 0 or (self.log and self.lower <= 0):
            raise ValueError(f"parameter {self.name}: needs a positive step, and a positive lower bound where log")

    def fitted(self, value: float) -> float:
        """The fitted scale of a value."""
        return math.log(value) if self.log else value

    def value(self, fitted: float) -> float:
        """The value of a number in the fitted scale, never outside of the bounds by rounding."""
        return float(np.clip(math.exp(fitted) if self.log else fitted, self.lower, self.upper))
