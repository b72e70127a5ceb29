"""The libraries of the extra ``export``, which an installation may lack."""

from __future__ import annotations

import importlib.util

from masiv.errors import InputError


def require_library(module: str, what: str) -> None:
    """Raises InputError if ``module``, which writes ``what``, is not installed."""
    if importlib.util.find_spec(module) is None:
        raise InputError(f"{what} are written by {module}, which is not installed: pip install 'masiv[export]'")
