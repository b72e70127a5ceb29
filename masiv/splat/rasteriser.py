"""Differentiable pictures of isotropic Gaussians; the arithmetic is in masiv/kernels/rasterise.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from masiv.errors import MasivError
from masiv.scene.camera import Camera


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
    image = _Draw.apply(means, scales, opacities, colours, camera)
    alpha = image[..., 3]
    seen = alpha > 0
    depth = torch.where(seen, image[..., 4] / torch.where(seen, alpha, 1.0), 0.0)
    return Rendering(image[..., :3] + (1 - alpha)[..., None] * background.to(image), alpha, depth)


def _numbers(camera: Camera, like: torch.Tensor) -> torch.Tensor:
    """``camera`` as the kernels read it."""
    pose, k = camera.world_to_camera, camera.intrinsics
    values = [*pose[:3, :3].ravel(), *pose[:3, 3], k[0, 0], k[0, 1], k[1, 1], k[0, 2], k[1, 2]]
    return torch.tensor(values, dtype=like.dtype)


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


class _Draw(torch.autograd.Function):
    """Gaussians -> image (H, W, 5): red, green, blue, alpha, alpha-weighted depth, over nothing."""

    @staticmethod
    def forward(
        ctx: Any,
        means: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        colours: torch.Tensor,
        camera: Camera,
    ) -> Any:
        from masiv.kernels.rasterise import CHANNELS, SPLAT_SIZE, TILE

        means, scales, opacities, colours = (t.detach().contiguous() for t in (means, scales, opacities, colours))
        kernels, numbers = _kernels(means.dtype), _numbers(camera, means)
        splats = means.new_empty(len(means), SPLAT_SIZE)
        boxes = torch.empty(len(means), 4, dtype=torch.int32)
        if len(means):
            kernels.project(numbers, means, scales, opacities, colours, splats, boxes, camera.width, camera.height)
        if not torch.isfinite(splats).all():
            raise MasivError(f"view {camera.name}: a Gaussian is not finite; lower the learning rates of reconstruct")
        columns, rows = math.ceil(camera.width / TILE), math.ceil(camera.height / TILE)
        tile_start, members, slots, first_slot = _bin(boxes, splats[:, 9], columns, rows)
        image = splats.new_zeros(camera.height, camera.width, CHANNELS)
        if len(members):
            transmittance = splats.new_ones(camera.height, camera.width)
            kernels.blend(splats, boxes, tile_start, members, image, transmittance, columns)
        ctx.save_for_backward(numbers, means, scales, splats, boxes, tile_start, members, slots, first_slot, image)
        ctx.columns = columns
        return image

    @staticmethod
    def backward(ctx: Any, image_bar: torch.Tensor) -> Any:
        saved = (t.detach() for t in ctx.saved_tensors)
        numbers, means, scales, splats, boxes, tile_start, members, slots, first_slot, image = saved
        means_bar, scales_bar, splat_bar = (torch.zeros_like(t) for t in (means, scales, splats))
        if len(members):
            image_bar = image_bar.contiguous()
            behind = (image_bar * image).sum(2)
            slot_bar = splats.new_empty(len(members), splats.shape[1])
            kernels = _kernels(splats.dtype)
            kernels.blend_adjoint(
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
            kernels.project_adjoint(
                numbers, means, scales, splats, slot_bar, first_slot, means_bar, scales_bar, splat_bar
            )
        return means_bar, scales_bar, splat_bar[:, 5], splat_bar[:, 6:9], None


def _kernels(dtype: torch.dtype) -> Any:
    import taichi as ti

    from masiv.kernels.rasterise import kernels

    return kernels({torch.float32: ti.f32, torch.float64: ti.f64}[dtype])
