"""The soft-L1 loss: squares for small residuals, absolute values for outliers (Charbonnier; SciPy's ``soft_l1``)."""

from __future__ import annotations

import math

import numpy as np

NORMAL_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute value."""
OUTLIER_SIGMAS = 2.0
"""Robust scale over the standard deviation estimated from the median."""


def robust_scale_of(residual: np.ndarray) -> float:
    """Robust scale [unit of ``residual``]: size from which a residual counts as an outlier."""
    return max(OUTLIER_SIGMAS * NORMAL_MAD * float(np.median(np.abs(residual))), 1e-9)


def soft_l1_sum(residual: np.ndarray, scale: float) -> float:
    """Sum over ``residual`` (M,) of sqrt(1 + r² / s²) - 1, no unit; of r² [its unit squared] if ``scale`` s is
    infinite."""
    if math.isinf(scale):
        return float(residual @ residual)
    return float((np.sqrt(1 + (residual / scale) ** 2) - 1).sum())


def soft_l1_mean_square(residual: np.ndarray, scale: float) -> float:
    """Mean over ``residual`` (M,) of 2 s² (sqrt(1 + r² / s²) - 1) [its unit squared]: the mean square if nothing is an
    outlier."""
    return float((2 * scale**2 * (np.sqrt(1 + (residual / scale) ** 2) - 1)).mean())


def soft_l1_weight(residual: np.ndarray, scale: float) -> np.ndarray:
    """Weights (M,) with which least squares of the weighted residual is one step of the robust problem."""
    return (1 + (residual / scale) ** 2) ** -0.25
