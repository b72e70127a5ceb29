"""Differentiable rendering of isotropic Gaussians; the kernels are in masiv/kernels/rasterise.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from masiv import runtime
from masiv.errors import InputError, MasivError
from masiv.scene.camera import Camera

_TYPES = (torch.float32, torch.float64)


@dataclass(frozen=True)
class Rendering:
    """rgb (H, W, 3); alpha (H, W) in [0, 1]; depth (H, W) [m]: expected depth along the optical axis, 0 if alpha is."""

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
    """Render isotropic Gaussians as ``camera`` sees them; differentiable with respect to all tensors.

    The splatting of 3DGS (Kerbl et al. 2023, doi:10.1145/3592433): a Gaussian is projected with the Jacobian J of the
    perspective division, Sigma' = J W Sigma W' J' (eq. 5), and the pixel's colour is the alpha-blended sum over the
    Gaussians in order of depth, C = sum_i c_i a_i prod_{j<i} (1 - a_j) (eq. 3), a_i = o_i exp(-x' Sigma'^-1 x / 2).
    As there, a_i is at most 0.99, is ignored below 1/255, and blending stops at a transmittance of 1e-4.

    It differs from 3DGS: Gaussians are isotropic, Sigma = s^2 I (eq. 6 without rotation). Colours do not depend on the
    direction (no spherical harmonics). There is one camera a call. The low-pass filter of 0.3 pixels^2 does not reduce
    the opacity (no compensation). Derivatives with respect to the camera are not computed.

    means (N, 3) [m, world]; scales (N,) standard deviations [m] > 0; opacities (N,) in [0, 1]; colours (N, 3);
    background (3,). All of one type, float32 or float64, on the CPU. Needs ``masiv.runtime.start``.
    Raises InputError for a wrong shape or type, MasivError if a projected Gaussian is not finite.

    Example:
        >>> import numpy as np
        >>> from masiv import runtime
        >>> from masiv.scene.camera import Camera
        >>> _ = runtime.start("cpu")
        >>> pinhole = np.array([[100.0, 0, 16], [0, 100, 16], [0, 0, 1]])
        >>> camera = Camera("front", 32, 32, pinhole, np.eye(4))
        >>> mean = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
        >>> one = torch.ones(1)
        >>> drawn = render(camera, mean, 0.05 * one, 0.9 * one, torch.ones(1, 3), torch.zeros(3))
        >>> drawn.rgb.shape, round(float(drawn.depth[16, 16].detach()), 3)
        (torch.Size([32, 32, 3]), 2.0)
        >>> drawn.rgb[:, :16].sum().backward()  # brighter on the left if the Gaussian moves to the left
        >>> bool(mean.grad[0, 0] < 0)
        True
    """
    _check(means, scales, opacities, colours, background)
    image = _Rasterize.apply(means, scales, opacities, colours, camera)
    alpha = image[..., 3]
    covered = alpha > 0
    depth = torch.where(covered, image[..., 4] / torch.where(covered, alpha, 1.0), 0.0)
    return Rendering(image[..., :3] + (1 - alpha)[..., None] * background.to(image), alpha, depth)


def _check(
    means: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, colours: torch.Tensor, background: torch.Tensor
) -> None:
    count = len(means)
    expected = {
        "means": (means, (count, 3)),
        "scales": (scales, (count,)),
        "opacities": (opacities, (count,)),
        "colours": (colours, (count, 3)),
        "background": (background, (3,)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise InputError(f"render: {name} has shape {tuple(tensor.shape)}, it must be {shape}")
        if name != "background" and (tensor.dtype != means.dtype or tensor.dtype not in _TYPES):
            raise InputError(
                f"render: {name} is {tensor.dtype} and means {means.dtype}: all must be float32, or all float64"
            )
        if tensor.device.type != "cpu":
            raise InputError(f"render: {name} is on {tensor.device}, it must be on the CPU")


def _camera_vector(camera: Camera, like: torch.Tensor) -> torch.Tensor:
    """``camera`` as the kernels read it: rotation (9), translation (3) [m], intrinsics (5) [pixels]."""
    pose, k = camera.world_to_camera, camera.intrinsics
    values = [*pose[:3, :3].ravel(), *pose[:3, 3], k[0, 0], k[0, 1], k[1, 1], k[0, 2], k[1, 2]]
    return torch.tensor(values, dtype=like.dtype)


def _tile_lists(boxes: torch.Tensor, depths: torch.Tensor, columns: int, rows: int) -> tuple[torch.Tensor, ...]:
    """The Gaussians of each tile, front to back; all int32.

    boxes (N, 4) [pixels], depths (N,) [m]. Returns tile_start (tiles + 1,), members (S,): the Gaussian of each entry,
    slots (S,): where its gradient goes, first_slot (N + 1,). Slots are in order of the Gaussians.
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


class _Rasterize(torch.autograd.Function):
    """Gaussians -> image (H, W, 5): red, green, blue, alpha, alpha-weighted depth [m], without background."""

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
        kernels, numbers = _kernels(means.dtype), _camera_vector(camera, means)
        splats = means.new_empty(len(means), SPLAT_SIZE)
        boxes = torch.empty(len(means), 4, dtype=torch.int32)
        if len(means):
            kernels.project(numbers, means, scales, opacities, colours, splats, boxes, camera.width, camera.height)
        if not torch.isfinite(splats).all():
            raise MasivError(f"view {camera.name}: a Gaussian is not finite; lower the learning rates of reconstruct")
        columns, rows = math.ceil(camera.width / TILE), math.ceil(camera.height / TILE)
        tile_start, members, slots, first_slot = _tile_lists(boxes, splats[:, 9], columns, rows)
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

    if dtype == torch.float64:
        runtime.check_float64("render: dtype torch.float64")
    return kernels({torch.float32: ti.f32, torch.float64: ti.f64}[dtype])
