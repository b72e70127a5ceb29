"""The result of ``reconstruct``: Gaussians at frame 0 and their motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from masiv.scene.calibration import Calibration
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.gaussians import Gaussians


@dataclass(frozen=True)
class DynamicGaussians:
    """canonical: the Gaussians at frame 0; deformation: their displacement and change of size at a time.

    calibration: the cameras as they were refined with them; None if they were kept as given.
    """

    canonical: Gaussians
    deformation: DeformationNetwork
    calibration: Calibration | None = None

    def at(self, time: float) -> Gaussians:
        """The Gaussians at ``time`` [s], 0 at the first frame; without gradients."""
        canonical = self.canonical
        with torch.no_grad():
            displacement, log_scale = self.deformation(canonical.means, time)
            scales = canonical.scales * log_scale.exp()
        return Gaussians(canonical.means + displacement, scales, canonical.opacities, canonical.colours)

    def base_positions(self, times: np.ndarray) -> np.ndarray:
        """Where the base motion takes the centre of the Gaussians at ``times`` (K,) [s], shape (K, 3) [m]."""
        with torch.no_grad():
            moved = self.deformation.base_displacements(torch.as_tensor(times, dtype=torch.float32))
        return (self.canonical.means.mean(dim=0) + moved).double().numpy()

    def save(self, folder: Path) -> None:
        """Write gaussians.ply, deformation.safetensors and, if cameras were refined, calibration.json to ``folder``."""
        self.canonical.save_ply(Path(folder) / "gaussians.ply")
        self.deformation.save(Path(folder) / "deformation.safetensors")
        if self.calibration is not None:
            self.calibration.save(folder)

    @classmethod
    def load(cls, folder: Path) -> DynamicGaussians:
        """Read what ``save`` wrote. Raises InputError if a file is missing or broken."""
        folder = Path(folder)
        return cls(
            Gaussians.load_ply(folder / "gaussians.ply"),
            DeformationNetwork.load(folder / "deformation.safetensors"),
            Calibration.load(folder),
        )
