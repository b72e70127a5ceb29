"""Stress over strain of a law, as a table."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.errors import InputError
from masiv.files import write_text

if TYPE_CHECKING:
    from masiv.materials.law import Law

MIN_STEPS, MAX_STEP = 80, 1e-3
"""Least number of increments of a loading, and longest increment [s]: the flow of a law is followed in such steps."""
STRAIN, RATE = 0.1, 1.0
"""Largest strain [1] and strain rate [1/s], if none are given."""
COLUMNS = ("test", "time_s", "strain", "stress_pa")

Curves = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def law_curves(law: Law, strain: float = STRAIN, rate: float = RATE) -> Curves:
    """Times (T,) [s], strains (T,) [1] and Kirchhoff stresses (T,) [Pa] of ``law`` in tests, by their name.

    Each test loads to ``strain`` (logarithmic) at ``rate`` [1/s] and unloads. Uniaxial: axial strain and stress, sides
    free. Simple shear: shear sqrt(3) ``strain`` and shear stress. Volume: ln J and mean stress. Raises InputError for
    numbers that are not positive.
    """
    from masiv.characterization import curves

    if not (math.isfinite(strain) and math.isfinite(rate) and strain > 0 and rate > 0):
        raise InputError(f"strain {strain} and rate {rate}: give positive numbers")
    law = curves.in_float64(law)
    steps = max(MIN_STEPS, math.ceil(strain / (rate * MAX_STEP)))
    dt = strain / (rate * steps)
    out: Curves = {}
    times = dt * np.arange(2 * steps + 1)

    def add(name: str, strains: np.ndarray, stress: np.ndarray) -> None:
        out[name] = times, np.concatenate([[0.0], strains]), np.concatenate([[0.0], stress])

    for name, sign in (("uniaxial tension", 1), ("uniaxial compression", -1)):
        strains = curves.there_and_back(sign * strain, steps)
        add(name, strains, curves.uniaxial(law, strains, dt).stress)
    shear = curves.there_and_back(math.sqrt(3) * strain, steps)
    add("simple shear", shear, curves.drive(law, curves.simple_shear(shear)[:, None], dt)[1][:, 0, 0, 1].numpy())
    for name, sign in (("dilation", 1), ("compression of the volume", -1)):
        volume = curves.there_and_back(sign * strain, steps)
        stress = curves.drive(law, curves.dilation(volume)[:, None], dt)[1][:, 0]
        add(name, volume, stress.diagonal(dim1=1, dim2=2).mean(dim=1).numpy())
    return out


def write_law_csv(law: Law, path: str | Path, *, strain: float = STRAIN, rate: float = RATE) -> None:
    """Write ``law_curves`` to ``path`` (.csv), a row an increment: test, time_s, strain, stress_pa."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for name, columns in law_curves(law, strain, rate).items():
        writer.writerows([name, *(f"{value:.9g}" for value in row)] for row in zip(*columns, strict=True))
    write_text(Path(path), text.getvalue())
