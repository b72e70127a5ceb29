"""Scalars that say how much a material is strained and stressed."""

from __future__ import annotations

import torch


def deviatoric_strain(gradients: torch.Tensor) -> torch.Tensor:
    """Equivalent deviatoric Hencky strain sqrt(2/3) |dev ln V| (...,) of gradients (..., 3, 3).

    In a stretch at constant volume it is the axial strain.
    """
    log = torch.log(torch.linalg.svdvals(gradients.double()))
    return (2 / 3) ** 0.5 * (log - log.mean(-1, keepdim=True)).norm(dim=-1)


def von_mises_stress(kirchhoff: torch.Tensor, gradients: torch.Tensor) -> torch.Tensor:
    """Von Mises stress sqrt(3/2) |dev sigma| (...,) [Pa] of the Cauchy stress sigma = tau / det F.

    kirchhoff: tau (..., 3, 3) [Pa]; gradients: elastic F (..., 3, 3). In a bar under tension it is the axial stress.
    """
    cauchy = kirchhoff.double() / torch.linalg.det(gradients.double())[..., None, None]
    mean = cauchy.diagonal(dim1=-2, dim2=-1).mean(-1)
    deviator = cauchy - mean[..., None, None] * torch.eye(3, dtype=cauchy.dtype)
    return 1.5**0.5 * deviator.flatten(-2).norm(dim=-1)
