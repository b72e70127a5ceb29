"""Gaussians a frame, as viewers and trainers of 3D Gaussian splatting store them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.errors import InputError
from masiv.export.kinematics import particle_spacing
from masiv.export.ply import frame_name
from masiv.files import atomic_folder

if TYPE_CHECKING:
    from masiv.splat.gaussians import Gaussians

SH_DEGREE = 3
"""Of the spherical harmonics that strict loaders ask for: 45 numbers, all zero."""
MAX_DISTANCE = 4.0
"""Particle spacings between the middle Gaussian and the nearest particle, above which they are of different bodies."""


def follow_gaussians(gaussians: Gaussians, positions: np.ndarray) -> Iterator[Gaussians]:
    """``gaussians`` of frame 0, moved by the particles ``positions`` (T, Q, 3) [m]: one result a frame.

    A mean follows the local affine map of the particles around it, a scale its change of volume. Raises InputError if
    the particles of frame 0 are not where the Gaussians are, or are fewer than 8.
    """
    from scipy.spatial import cKDTree

    from masiv.report.follow import Binding

    means = gaussians.means.detach().numpy()
    away = float(np.median(cKDTree(positions[0]).query(means)[0]))
    if away > MAX_DISTANCE * particle_spacing(positions[0]):
        raise InputError(
            f"the Gaussians are {away:.3g} m away from the particles of frame 0: they are of another body or place"
        )
    binding = Binding.at_rest(gaussians, positions[0])
    for now in positions:
        yield binding.moved(now)


def write_gaussians(frames: Iterable[Gaussians], folder: str | Path) -> None:
    """Write ``folder``/frame_0000.ply …, one file for each of ``frames``, in the layout of Kerbl et al. 2023.

    Colors are spherical harmonics of degree 3 whose parts above degree 0 (``f_rest``) are zero, opacities are logits,
    scales logarithms [ln m], rotations unit quaternions, the real part first. Raises InputError if ``folder`` holds
    something.
    """
    with atomic_folder(Path(folder)) as temporary:
        for frame, gaussians in enumerate(frames):
            gaussians.save_ply(temporary / frame_name(frame, "ply"), sh_degree=SH_DEGREE)
