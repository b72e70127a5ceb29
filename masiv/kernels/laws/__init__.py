"""Classical laws as Taichi functions (F, c) -> (elastic F, Kirchhoff stress), one law a file."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def law_function(kind: str) -> Callable[..., Any]:
    """The function in the module of that name: trial deformation gradient and coefficients -> elastic deformation
    gradient after the return mapping, and stress [Pa]."""
    return getattr(importlib.import_module(f"{__name__}.{kind}"), kind)
