"""refine.npz: the residuals of refine, before and after, and the force that no effect explains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from masiv.files import write_npz
from masiv.refinement.discrepancy_field import sampled_fields
from masiv.refinement.result import RefineResult


def arrays(result: RefineResult) -> dict[str, Any]:
    """refine.npz: ``observations``, their names; and of each, named ``key@observation``, ``times`` (T,) [s], ``points``
    (N, 3) [m] at the start, ``observed``, ``before`` and ``after`` (T, N, A) [m], the last two simulated less observed,
    ``fit_count``, how many instants were fitted, and ``test_count``, how many of the last ones no decision saw. World
    frame, along the A axes that were measured.

    With a discrepancy force also ``force_places`` (T, S, 3) [m], where S of the points were (NaN if not seen), and
    ``force`` (T, S, 3) [m/s^2], the acceleration there; world frame."""
    out: dict[str, Any] = {"observations": np.array([e.name for e in result.observations])}
    for e, before, after in zip(result.observations, result.before.fields, result.after.fields, strict=True):
        own = {
            "times": e.times,
            "points": e.points_in_world,
            "observed": e.values_in_world,
            "before": e.field_in_world(before).astype(np.float32),
            "after": e.field_in_world(after).astype(np.float32),
            "fit_count": np.array(e.fit_count),
            "test_count": np.array(e.test_count),
        }
        out |= {f"{key}@{e.name}": value for key, value in own.items()}
    for f in sampled_fields(result):
        out |= {f"force_places@{f.observation}": f.places, f"force@{f.observation}": f.acceleration}
    return out


def save_arrays(path: Path, result: RefineResult) -> None:
    """Write ``arrays``, completely or not at all."""
    write_npz(path, **arrays(result))
