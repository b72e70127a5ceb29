"""Numbers with standard errors and units, for people."""

from __future__ import annotations

import math

PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
SCALED = ("Pa", "Pa s")
"""Units that take a prefix."""


def quantity(value: float, unit: str, stderr: float | None = None) -> str:
    """Such as 112 ± 37 kPa: two digits of the standard error, and as many places of the value; three significant digits
    where it is not known."""
    factor, prefix = 1.0, ""
    if unit in SCALED:
        factor, prefix = next(((f, p) for f, p in PREFIXES if abs(value) >= f), (1.0, ""))
    value = value / factor
    unit = "" if unit in ("", "1") else f" {prefix}{unit.replace('^2', '²').replace('^3', '³')}"
    if stderr is None or not math.isfinite(stderr) or stderr <= 0:
        return f"{value:.3g}{unit}"
    error = stderr / factor
    places = 1 - math.floor(math.log10(error))
    if places >= 0 and max(abs(value), error) < 1e5 and places <= 6:
        return f"{value:.{places}f} ± {error:.{places}f}{unit}"
    return f"{value:.3g} ± {error:.2g}{unit}"


def percent(probability: float) -> str:
    """A probability; never 0 or 100 %, which no measurement gives."""
    if probability < 0.001:
        return "less than 0.1 %"
    if probability > 0.999:
        return "more than 99.9 %"
    digits = 1 if min(probability, 1 - probability) < 0.1 else 0
    return f"{100 * probability:.{digits}f} %"


def millimetres(value: float) -> str:
    """Three significant digits, never in powers of ten."""
    if value <= 0:
        return "0 mm"
    places = max(0, 2 - math.floor(math.log10(value)))
    return f"{value:.{places}f} mm"
