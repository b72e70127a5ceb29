"""Reference of masiv/splat/rasteriser.py in plain torch, float64, without tiles; the tests compare the two."""

from __future__ import annotations

import torch

from masiv.scene.camera import Camera


def _render(
    camera: Camera,
    means: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colours: torch.Tensor,
    background: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """rgb (H, W, 3), alpha (H, W), depth (H, W), as ``render``; memory N H W. Kerbl et al. 2023, eq. 3, 5, 6."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)
    intrinsics = torch.as_tensor(camera.intrinsics, dtype=torch.float64)
    points = means @ pose[:3, :3].T + pose[:3, 3]
    order = torch.argsort(points[:, 2].detach(), stable=True)
    order = order[points[order, 2] > 0.01]
    points, scales, opacities, colours = points[order], scales[order], opacities[order], colours[order]
    projected = points @ intrinsics.T
    centres = projected[:, :2] / projected[:, 2:]

    # d(u, v)/d(x, y, z) of the homogeneous division.
    z = points[:, 2]
    jacobian = (intrinsics[:2][None] - centres[:, :, None] * intrinsics[2]) / z[:, None, None]
    covariance = scales[:, None, None] ** 2 * jacobian @ jacobian.mT + 0.3 * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(covariance)

    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    offset = torch.stack([x, y], dim=-1) + 0.5 - centres[:, None, None]  # (N, H, W, 2)
    power = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, conic, offset)
    alpha = (opacities[:, None, None] * power.exp()).clamp(max=0.99)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=0)
    alpha = torch.where(after.detach() >= 1e-4, alpha, 0.0)  # ``after`` falls: nothing behind the stop counts
    before = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, dim=0)[:-1]])
    weight = before * alpha
    total = weight.sum(0)
    rgb = torch.einsum("nhw,nc->hwc", weight, colours) + (1 - total)[..., None] * background
    depth = torch.einsum("nhw,n->hw", weight, z) / torch.where(total > 0, total, 1.0)
    return rgb, total, depth
