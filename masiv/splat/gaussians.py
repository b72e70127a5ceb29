"""Isotropic 3D Gaussians and their file, in the PLY layout of Kerbl et al. 2023 that viewers of 3DGS read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from masiv.errors import InputError, MasivError
from masiv.files import atomic, require_file
from masiv.strict import reason

_SH_DEGREE_0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 1/2 + _SH_DEGREE_0 f_dc."""
_OPACITY_MARGIN = 1e-6
"""Opacities are stored as logits, which are infinite at 0 and 1."""
_POINT = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_SHAPE = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_COLUMNS = (*_POINT, *_SHAPE)


@dataclass(frozen=True)
class Gaussians:
    """means (N, 3) [m, world]; scales (N,) standard deviations [m] > 0; opacities (N,) in [0, 1]; colours (N, 3) RGB,
    1 is white. Float tensors, after any activation."""

    means: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor

    def __len__(self) -> int:
        return len(self.means)

    def save_ply(self, path: Path, *, sh_degree: int = 0) -> None:
        """Write ``path`` (float32, binary PLY) completely or not at all. sh_degree: of the spherical harmonics in the
        file, which are zero above 0; many loaders ask for 3. Raises MasivError for non-finite values."""
        count = len(self)
        rest = tuple(f"f_rest_{k}" for k in range(3 * ((sh_degree + 1) ** 2 - 1)))
        names = (*_POINT, *rest, *_SHAPE)
        columns: dict[str, np.ndarray] = {name: np.zeros(count) for name in names}
        means, colours = self.means.detach().cpu().numpy(), self.colours.detach().cpu().numpy()
        for axis, name in enumerate("xyz"):
            columns[name] = means[:, axis]
            columns[f"f_dc_{axis}"] = (colours[:, axis] - 0.5) / _SH_DEGREE_0
            columns[f"scale_{axis}"] = self.scales.detach().double().log().cpu().numpy()
        opacities = self.opacities.detach().double().clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
        columns["opacity"] = torch.logit(opacities).cpu().numpy()
        columns["rot_0"] = np.ones(count)
        rows = np.empty(count, dtype=[(name, "f4") for name in names])
        for name, column in columns.items():
            if not np.isfinite(column).all():
                raise MasivError(f"{path} is not written: a Gaussian's {name} is not finite")
            rows[name] = column
        with atomic(path) as temporary:
            PlyData([PlyElement.describe(rows, "vertex")]).write(str(temporary))

    @classmethod
    def load_ply(cls, path: Path) -> Gaussians:
        """Read a file in the 3DGS layout. Raises InputError if it is missing, broken or anisotropic."""
        try:
            rows = PlyData.read(str(require_file(path)))["vertex"].data
            columns = {name: np.asarray(rows[name], dtype=np.float64) for name in _COLUMNS if name[0] != "n"}
        except Exception as error:  # the library raises what it likes for a damaged file
            raise InputError(
                f"{path} is not a PLY file of Gaussians ({reason(error, path)}); run reconstruct again"
            ) from error
        for name, column in columns.items():
            if not np.isfinite(column).all():
                raise InputError(f"{path}: {name} of a Gaussian is not finite; run reconstruct again")
        scales = np.stack([columns[f"scale_{axis}"] for axis in range(3)], axis=1)
        if np.ptp(scales, axis=1).max(initial=0.0) > 1e-4:
            raise InputError(f"{path} holds anisotropic Gaussians; masiv draws isotropic ones: run masiv reconstruct")
        means = np.stack([columns[axis] for axis in "xyz"], axis=1)
        colours = 0.5 + _SH_DEGREE_0 * np.stack([columns[f"f_dc_{c}"] for c in range(3)], axis=1)
        tensors = (means, np.exp(scales[:, 0]), 1 / (1 + np.exp(-columns["opacity"])), colours)
        return cls(*(torch.as_tensor(t).float() for t in tensors))
