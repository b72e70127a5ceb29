"""Particles as a sequence of PLY files, which most programs for points open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.export.kinematics import Deformation, equivalent_strain, velocities, volume_ratio
from masiv.files import atomic_folder
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    from masiv.simulation.rollout import Rollout


def frame_name(frame: int, extension: str) -> str:
    """The name of a file of a sequence: as long for all frames, so that programs find the sequence."""
    return f"frame_{frame:04d}.{extension}"


def write_ply_sequence(rollout: Rollout, folder: str | Path, *, progress: Progress = silent) -> None:
    """Write ``folder``/frame_0000.ply … (binary, float32), a vertex a particle in the order of ``rollout``.

    Properties: x, y, z [m], vx, vy, vz [m/s] and, of a body that fills a volume, ``volume_ratio`` and
    ``equivalent_strain`` as in ``write_vtkhdf``. Raises InputError if ``folder`` holds something.
    """
    from plyfile import PlyData, PlyElement

    speed = velocities(rollout.positions, rollout.times)
    deformation = Deformation.since(rollout.positions[0])
    names = ["x", "y", "z", "vx", "vy", "vz"]
    if deformation is not None:
        names += ["volume_ratio", "equivalent_strain"]
    with atomic_folder(Path(folder)) as temporary:
        for frame, now in enumerate(rollout.positions):
            columns = [*now.T, *speed[frame].T]
            if deformation is not None:
                gradients = deformation.gradients(now)
                columns += [volume_ratio(gradients), equivalent_strain(gradients)]
            rows = np.empty(len(now), dtype=[(name, "f4") for name in names])
            for name, column in zip(names, columns, strict=True):
                rows[name] = column
            element = PlyElement.describe(rows, "vertex")
            PlyData([element]).write(str(temporary / frame_name(frame, "ply")))
            progress("export", frame + 1, len(rollout.positions))
