"""Typed access to the JSON files of data sets. Each error is an InputError that names the file and the entry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.strict import quoted

LARGEST = 2**1000
"""Integers beyond are no numbers that a float holds."""


def entries(value: Any, where: str, of_what: str) -> list[Any]:
    """``value`` as a list that is not empty. Raises InputError."""
    if not isinstance(value, list) or not value:
        raise InputError(f"{where} must be a list with one entry a {of_what}")
    return value


def mapping(value: Any, where: str) -> Mapping[str, Any]:
    """``value`` as a mapping. Raises InputError."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where} must be a JSON object, it is a {type(value).__name__}")
    return value


def number(row: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """``row[key]``, finite. Raises InputError if it is missing without a default, or not a finite number."""
    value = row.get(key, default)
    if value is None:
        raise InputError(f"{where} has no '{key}'")
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST:
        value = math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: '{key}' is {quoted(value)}, it must be a finite number")
    return float(value)


def text(row: Mapping[str, Any], key: str, where: str) -> str:
    """``row[key]``, a string that is not empty. Raises InputError."""
    value = row.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(
            f"{where} has no '{key}'" if value is None else f"{where}: '{key}' is {quoted(value)}, not a name"
        )
    return value


def array(row: Mapping[str, Any], key: str, shapes: tuple[tuple[int, ...], ...], where: str) -> np.ndarray:
    """``row[key]`` as float64 of one of the ``shapes``, finite. Raises InputError."""
    if key not in row:
        raise InputError(f"{where} has no '{key}'")
    try:
        values = np.array(row[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: '{key}' is no matrix of numbers") from error
    if values.shape not in shapes or not np.isfinite(values).all():
        sizes = " or ".join("×".join(map(str, shape)) for shape in shapes)
        raise InputError(f"{where}: '{key}' must be {sizes} finite numbers")
    return values
