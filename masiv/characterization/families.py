"""Which classical law resembles a law most: each family is fitted to its stress responses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

from masiv.characterization import curves
from masiv.errors import InputError
from masiv.materials.classical import CONTINUUM, PARAMETERS, UNITS, ClassicalLaw
from masiv.materials.law import Law

COMPARED_STRAINS = 24
"""Strains at which responses are compared, each way."""
FINE_INCREMENTS = 4
"""Increments between two of them, for the law itself and for families whose flow depends on path or rate."""
MIN_RELATIVE_RESPONSE = 0.05
"""Responses are scaled by their own RMS, but by at least this fraction of the RMS of all."""
MISFIT_TIE = 0.5
"""Difference of misfits [%] that counts as none: the family with fewer parameters comes first."""
BOUNDS = {"poissons_ratio": (-0.9, 0.499), "friction_angle": (1.0, 80.0)}


@dataclass(frozen=True)
class Match:
    """A family of laws: RMS difference [%] of its responses from the law's over the observed range; its parameters."""

    kind: str
    misfit_percent: float
    parameters: dict[str, dict[str, Any]]


def nearest_families(law: Law, *, strain: float, log_volume: tuple[float, float], rate: float) -> list[Match]:
    """Every family that can be fitted, nearest first.

    The paths go there and back: shear at rest volume and compressed to log_volume[0], stretch and compression at
    constant volume, all to the equivalent ``strain``, and changes of volume to ``log_volume``, at ``rate`` [1/s].
    """
    law = curves.in_float64(law)
    dt = strain / (rate * COMPARED_STRAINS)
    fine = _paths(strain, log_volume, COMPARED_STRAINS * FINE_INCREMENTS)
    target = curves.drive(law, fine, dt / FINE_INCREMENTS)[1][FINE_INCREMENTS - 1 :: FINE_INCREMENTS]
    power = target.square().sum((2, 3)).mean(0)
    scale = torch.sqrt(torch.maximum(power, MIN_RELATIVE_RESPONSE**2 * power.mean()))[None, :, None, None]
    coarse = _paths(strain, log_volume, COMPARED_STRAINS)
    guesses = _guesses(law, target)
    found = []
    for kind in CONTINUUM:
        names = PARAMETERS[kind]
        if set(names) <= guesses.keys():
            refined = FINE_INCREMENTS if any("viscosity" in name or "angle" in name for name in names) else 1
            paths = fine if refined > 1 else coarse
            match = _fit_family(kind, [guesses[name] for name in names], paths, dt / refined, target, scale)
            found.append(match)
    best = min(match.misfit_percent for match in found)
    near = [match for match in found if match.misfit_percent <= best + MISFIT_TIE]
    others = [match for match in found if match.misfit_percent > best + MISFIT_TIE]
    return [
        *sorted(near, key=lambda m: (len(m.parameters), m.misfit_percent)),
        *sorted(others, key=lambda m: m.misfit_percent),
    ]


def _paths(strain: float, log_volume: tuple[float, float], points: int) -> torch.Tensor:
    """Increments (2 * points, 6, 3, 3)."""
    there = curves.there_and_back
    shear = there(math.sqrt(3) * strain, points)
    return torch.stack(
        [
            curves.simple_shear(shear),
            curves.simple_shear(shear, log_volume[0]),
            curves.stretch(there(strain, points)),
            curves.stretch(there(-strain, points)),
            curves.dilation(there(log_volume[0], points)),
            curves.dilation(there(log_volume[1], points)),
        ],
        dim=1,
    )


def _guesses(law: Law, target: torch.Tensor) -> dict[str, float]:
    shear, bulk = curves.moduli_at_rest(law)
    bulk = max(bulk, 1.0)
    shear = max(shear, 1e-2 * bulk)
    deviator = target[:, 0] - target[:, 0].diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3).double()
    return {
        "youngs_modulus": 9 * bulk * shear / (3 * bulk + shear),
        "poissons_ratio": float(np.clip((3 * bulk - 2 * shear) / (2 * (3 * bulk + shear)), -0.8, 0.49)),
        "yield_stress": max(float(deviator.norm(dim=(1, 2)).quantile(0.9)), 1e-3 * shear),
        "friction_angle": 30.0,
        "viscosity": max(float(target[:, 0, 0, 1].abs().max()), 1e-3 * shear) / 10,
        "shear_modulus": shear,
        "bulk_modulus": bulk,
        "plastic_viscosity": 1e-3 * shear,
    }


def _fit_family(
    kind: str, start: list[float], paths: torch.Tensor, dt: float, target: torch.Tensor, scale: torch.Tensor
) -> Match:
    names = PARAMETERS[kind]
    ways = [_transforms(name) for name in names]

    def values(x: np.ndarray) -> dict[str, float]:
        return {name: back(float(v)) for name, (_, back), v in zip(names, ways, x, strict=True)}

    def residual(x: np.ndarray) -> np.ndarray:
        stress = curves.drive(curves.in_float64(ClassicalLaw(kind, **values(x))), paths, dt)[1]
        every = len(stress) // len(target)
        stress = stress[every - 1 :: every]
        off = (stress - target) / (scale * math.sqrt(len(target) * target.shape[1]))
        return torch.nan_to_num(off, nan=1e3, posinf=1e3, neginf=-1e3).flatten().numpy()

    x0 = np.array([to(value) for (to, _), value in zip(ways, start, strict=True)])
    lowest, highest = x0 - 8, x0 + 8
    try:
        found = least_squares(residual, x0, bounds=(lowest, highest), diff_step=1e-4, max_nfev=14)
    except InputError:  # a step out of the family's range of parameters
        return Match(kind, math.inf, {})
    misfit = 100 * math.sqrt(2 * found.cost)
    return Match(kind, misfit, {n: {"value": v, "unit": UNITS[n]} for n, v in values(found.x).items()})


def _transforms(name: str) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """Parameter -> fitted variable, and back: a logit within bounds, a logarithm without."""
    if name not in BOUNDS:
        return math.log, math.exp
    low, high = BOUNDS[name]

    def to(value: float) -> float:
        share = (value - low) / (high - low)
        return math.log(share / (1 - share))

    def back(x: float) -> float:
        return low + (high - low) / (1 + math.exp(-x))

    return to, back
