"""Differentiable pictures of isotropic Gaussians: projection in torch, blending in masiv/kernels/rasterise.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from masiv.errors import MasivError
from masiv.scene.camera import Camera

LOW_PASS = 0.3
"""Added to the variance of a projected Gaussian [pixels^2]: it never falls between pixels (Kerbl et al. 2023)."""
NEAR = 0.01
"""Gaussians nearer to the camera plane than this [m] are not drawn."""


@dataclass(frozen=True)
class Rendering:
    """A picture. rgb (H, W, 3); alpha (H, W) in [0, 1]; depth (H, W) [m], expected depth where alpha > 0, else 0."""

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor


def render(
    camera: Camera,
    means: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colours: torch.Tensor,
    background: torch.Tensor,
) -> Rendering:
    """The picture of Gaussians that ``camera`` takes; gradients flow to all but the camera.

    means (N, 3) [m]; scales (N,) standard deviations [m]; opacities (N,) in [0, 1]; colours (N, 3); background (3,).
    float32 or float64, after ``masiv.runtime.start``. Raises MasivError where a projected Gaussian is not finite.
    """
    centres, covariances, depths = project(camera, means, scales)
    a, b, c = covariances.unbind(1)
    determinant = a * c - b * b
    conics = torch.stack([c, -b, a], dim=1) / determinant[:, None]
    splats = torch.cat([centres, conics, opacities[:, None], colours, depths[:, None]], dim=1)
    with torch.no_grad():
        if not torch.isfinite(splats).all():
            raise MasivError(f"view {camera.name}: a Gaussian is not finite; lower the learning rates of reconstruct")
        boxes = _boxes(camera, centres, a, c, opacities, depths)
    image = _Blend.apply(splats, boxes, depths.detach(), camera.width, camera.height)
    alpha = image[..., 3]
    seen = alpha > 0
    depth = torch.where(seen, image[..., 4] / torch.where(seen, alpha, 1.0), 0.0)
    return Rendering(image[..., :3] + (1 - alpha)[..., None] * background.to(image), alpha, depth)


def project(
    camera: Camera, means: torch.Tensor, scales: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """EWA projection (Zwicker et al. 2001) of Gaussians: centres (N, 2) [pixels], covariances xx, xy, yy (N, 3)
    [pixels^2] with the low-pass, depths (N,) [m]. Those nearer than NEAR get a harmless stand-in depth of 1 m here."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)
    k = camera.intrinsics
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    inverse = 1 / torch.where(z > NEAR, z, 1.0)
    u = (float(k[0, 0]) * x + float(k[0, 1]) * y) * inverse
    v = float(k[1, 1]) * y * inverse
    # Rows of the projection's Jacobian are (fx, skew, -u) / z and (0, fy, -v) / z.
    spread = (scales * inverse).square()
    xx = spread * (float(k[0, 0] ** 2 + k[0, 1] ** 2) + u * u) + LOW_PASS
    xy = spread * (float(k[0, 1] * k[1, 1]) + u * v)
    yy = spread * (float(k[1, 1] ** 2) + v * v) + LOW_PASS
    centres = torch.stack([u + float(k[0, 2]), v + float(k[1, 2])], dim=1)
    return centres, torch.stack([xx, xy, yy], dim=1), z


def _boxes(camera: Camera, centres: Any, xx: Any, yy: Any, opacities: Any, depths: Any) -> torch.Tensor:
    """Pixels (x0, y0, x1, y1), half-open, whose alpha can reach 1/255: (N, 4) int32; empty for what is not drawn."""
    drawn = (opacities * 255 > 1) & (depths > NEAR)
    reach = (2 * torch.log(torch.where(drawn, opacities * 255, 1.0))).sqrt()[:, None] * torch.stack([xx, yy], 1).sqrt()
    limit = torch.tensor([camera.width, camera.height], dtype=centres.dtype, device=centres.device)
    low = (centres - reach - 0.5).ceil().clamp(min=0).minimum(limit)
    high = ((centres + reach - 0.5).floor() + 1).clamp(min=0).minimum(limit)
    empty = (high <= low).any(1, keepdim=True) | ~drawn[:, None]
    return torch.cat([low, high], dim=1).masked_fill(empty, 0).to(torch.int32)


def _bin(boxes: torch.Tensor, depths: torch.Tensor, columns: int, rows: int) -> tuple[torch.Tensor, ...]:
    """Lists of Gaussians for each tile, front to back.

    tile_start (tiles + 1,), members (S,) Gaussian and slots (S,) of each entry, first_slot (N + 1,); all int32.
    Slots are numbered Gaussian by Gaussian, in order of index.
    """
    from masiv.kernels.rasterise import TILE

    low = boxes[:, :2].div(TILE, rounding_mode="floor")
    size = (boxes[:, 2:] + (TILE - 1)).div(TILE, rounding_mode="floor") - low
    counts = (size[:, 0] * size[:, 1]).long()
    first_slot = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    order = torch.argsort(depths, stable=True)
    by_depth = torch.repeat_interleave(order, counts[order])
    starts = torch.nn.functional.pad(counts[order].cumsum(0), (1, 0))[:-1]
    within = torch.arange(len(by_depth), device=boxes.device) - torch.repeat_interleave(starts, counts[order])
    width = size[by_depth, 0].long()
    tile = (low[by_depth, 1] + within // width) * columns + low[by_depth, 0] + within % width
    tile, sequence = torch.sort(tile, stable=True)
    members = by_depth[sequence]
    slots = first_slot[members] + within[sequence]
    tile_start = torch.searchsorted(tile, torch.arange(columns * rows + 1, device=boxes.device, dtype=tile.dtype))
    return tuple(t.to(torch.int32).contiguous() for t in (tile_start, members, slots, first_slot))


class _Blend(torch.autograd.Function):
    """splats (N, 10) -> image (H, W, 5): red, green, blue, alpha, alpha-weighted depth, over nothing."""

    @staticmethod
    def forward(
        ctx: Any, splats: torch.Tensor, boxes: torch.Tensor, depths: torch.Tensor, width: int, height: int
    ) -> Any:
        from masiv.kernels.rasterise import CHANNELS, TILE

        columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
        splats = splats.detach().contiguous()
        tile_start, members, slots, first_slot = _bin(boxes, depths, columns, rows)
        image = splats.new_zeros(height, width, CHANNELS)
        if len(members):
            transmittance = splats.new_ones(height, width)
            _kernels(splats.dtype).blend(splats, boxes, tile_start, members, image, transmittance, columns)
        ctx.save_for_backward(splats, boxes, tile_start, members, slots, first_slot, image)
        ctx.columns = columns
        return image

    @staticmethod
    def backward(ctx: Any, image_bar: torch.Tensor) -> Any:
        splats, boxes, tile_start, members, slots, first_slot, image = (t.detach() for t in ctx.saved_tensors)
        splat_bar = torch.zeros_like(splats)
        if len(members):
            image_bar = image_bar.contiguous()
            behind = (image_bar * image).sum(2)
            slot_bar = splats.new_empty(len(members), splats.shape[1])
            module = _kernels(splats.dtype)
            module.blend_adjoint(
                splats,
                boxes,
                tile_start,
                members,
                slots,
                image_bar,
                torch.ones_like(behind),
                behind,
                slot_bar,
                ctx.columns,
            )
            module.sum_slots(slot_bar, first_slot, splat_bar)
        return splat_bar, None, None, None, None


def _kernels(dtype: torch.dtype) -> Any:
    import taichi as ti

    from masiv.kernels.rasterise import kernels

    return kernels({torch.float32: ti.f32, torch.float64: ti.f64}[dtype])
