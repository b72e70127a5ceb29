"""Observed and simulated points for the 3D view: chosen points at chosen instants, in few bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from masiv.report.page import encoded
from masiv.scene.scene import Ground
from masiv.subsample import evenly_spread, kd_tree_subset

MAX_POINTS = 2000
MAX_INSTANTS = 60
"""That are shown of a motion."""
MAX_BYTES = 400_000
"""Of all motions together, before base64."""
BYTES_PER_POINT = 14
"""Two places of three numbers and an error, 2 bytes each."""
PATHS = 12
"""Points up to which the paths of all of them are drawn."""
UNKNOWN = 2**16 - 1
"""Stands for NaN."""


@dataclass(frozen=True)
class Motion:
    """One recording, observed and simulated.

    name: shown where there are several. times (T,) [s]. simulated (T, N, 3) [m]. observed (T, N, 3) [m], the same
    points; NaN where nothing was observed. parts: (how many instants, name) one after the other, such as (12, fitted).
    """

    name: str
    times: np.ndarray
    simulated: np.ndarray
    observed: np.ndarray
    parts: Sequence[tuple[int, str]] = field(default=())

    @property
    def error_mm(self) -> np.ndarray:
        """(T, N), NaN where nothing was observed."""
        return 1e3 * np.linalg.norm(self.simulated - self.observed, axis=2)

    @property
    def part_names(self) -> list[str]:
        """(T,)"""
        names = [name for count, name in self.parts for _ in range(count)]
        return [*names, *[""] * len(self.times)][: len(self.times)]


def shown_instants(count: int) -> np.ndarray:
    """Indices of at most MAX_INSTANTS of ``count`` instants, the first and the last among them."""
    return np.array(evenly_spread(range(count), MAX_INSTANTS), dtype=int)


def motion_data(motions: Sequence[Motion], up: np.ndarray, ground: Ground | None) -> dict[str, Any]:
    """What report.js draws. All motions have the same scale of errors."""
    errors = [motion.error_mm for motion in motions]
    known = np.concatenate([error[np.isfinite(error)] for error in errors])
    top = float(np.quantile(known, 0.99)) if len(known) else 0.0
    instants = [shown_instants(len(motion.times)) for motion in motions]
    most = min(MAX_POINTS, MAX_BYTES // (BYTES_PER_POINT * sum(len(found) for found in instants)))
    return {
        "up": [float(value) for value in up],
        "ground": None if ground is None else {"normal": ground.normal.tolist(), "height": float(ground.height)},
        "errorTop": max(top, 1e-6),
        "motions": [
            _packed(motion, error, which, max(most, 1))
            for motion, error, which in zip(motions, errors, instants, strict=True)
        ],
    }


def _packed(motion: Motion, error: np.ndarray, instants: np.ndarray, most: int) -> dict[str, Any]:
    rest = motion.simulated[0]
    points = kd_tree_subset(rest, most)
    simulated, observed = motion.simulated[instants][:, points], motion.observed[instants][:, points]
    both = np.concatenate([simulated.reshape(-1, 3), observed.reshape(-1, 3)])
    low, high = np.nanmin(both, axis=0), np.nanmax(both, axis=0)
    span = np.maximum(high - low, 1e-9)
    whole = [error[k][np.isfinite(error[k])] for k in instants]
    shown = error[instants][:, points]
    top = max(float(np.nanmax(shown, initial=0.0)), 1e-9)
    names = motion.part_names
    return {
        "name": motion.name,
        "times": [float(f"{t:.6g}") for t in motion.times[instants]],
        "frames": instants.tolist(),
        "frameCount": len(motion.times),
        "parts": [names[k] for k in instants],
        "meanError": [float(e.mean()) if len(e) else None for e in whole],
        "largestError": [float(e.max()) if len(e) else None for e in whole],
        "points": len(points),
        "of": int(motion.simulated.shape[1]),
        "paths": motion.simulated.shape[1] <= PATHS,
        "low": low.tolist(),
        "span": span.tolist(),
        "simulated": _integers((simulated - low) / span),
        "observed": _integers((observed - low) / span),
        "error": _integers(shown / top),
        "errorScale": top,
    }


def _integers(values: np.ndarray) -> str:
    """0 to 1 -> 0 to UNKNOWN − 1 as little-endian uint16, base64; UNKNOWN for NaN."""
    known = np.isfinite(values)
    scaled = np.where(known, np.clip(values, 0, 1), 0) * (UNKNOWN - 1)
    return encoded(np.where(known, scaled.round(), UNKNOWN).astype("<u2").tobytes())
