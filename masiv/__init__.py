"""masiv: digital twins of moving, deforming objects, from multi-view video or tracked points.

The library is documented in ``masiv.api``; run folders and the stages of the commands in ``masiv.pipeline``,
results in the formats of other programs in ``masiv.export``.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# torch's threads spin while they wait for each other and for Taichi's, which makes a busy machine ten times slower;
# read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

if TYPE_CHECKING:
    from masiv import export
    from masiv.api import (
        calibrated,
        estimate_trajectory,
        evaluate,
        identify,
        load_config,
        read_scene,
        reconstruct,
        refine,
        simulate,
    )
    from masiv.config import Config
    from masiv.errors import InputError, MasivError, NonFiniteError
    from masiv.pipeline import RefineRequest, SceneRequest, SimulateRequest, open_run, reopen_run
    from masiv.twin import Twin

_MODULE_OF = {
    **dict.fromkeys(
        (
            "calibrated",
            "estimate_trajectory",
            "evaluate",
            "identify",
            "load_config",
            "read_scene",
            "reconstruct",
            "refine",
            "simulate",
        ),
        "masiv.api",
    ),
    **dict.fromkeys(("RefineRequest", "SceneRequest", "SimulateRequest", "open_run", "reopen_run"), "masiv.pipeline"),
    **dict.fromkeys(("InputError", "MasivError", "NonFiniteError"), "masiv.errors"),
    "Config": "masiv.config",
    "Twin": "masiv.twin",
}
_PACKAGES = ("export",)
"""Packages whose functions are part of the library under their own name."""

__all__ = [
    "Config",
    "InputError",
    "MasivError",
    "NonFiniteError",
    "RefineRequest",
    "SceneRequest",
    "SimulateRequest",
    "Twin",
    "calibrated",
    "estimate_trajectory",
    "evaluate",
    "export",
    "identify",
    "load_config",
    "open_run",
    "read_scene",
    "reconstruct",
    "refine",
    "reopen_run",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Names are imported when they are used: torch and Taichi take seconds, and ``masiv --help`` needs neither."""
    if name in _PACKAGES:
        return importlib.import_module(f"masiv.{name}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'masiv' has no attribute '{name}'")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
