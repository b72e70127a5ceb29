"""One MLS-MPM substep in plain torch, slow: any dtype, gradients by autograd. The reference of tests."""

from __future__ import annotations

import torch

from masiv.materials.law import Law
from masiv.mpm.state import State


def _substep(state: State, law: Law, *, mass, volume, spacing, substep, gravity, contact) -> State:
    """The state after one substep; arguments as ``masiv.mpm.simulator.Simulator``'s constants (per particle)."""
    x, v, affine, trial = state.tensors()
    f = law.project(trial, substep)
    tau = law.stress(f)
    scaled = x / spacing
    base = torch.floor(scaled.detach() - 0.5)
    fx = scaled - base
    w = torch.stack([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2])  # (3 nodes, N, 3 axes)
    offsets = torch.cartesian_prod(*[torch.arange(3)] * 3)  # (27, 3)
    weight = torch.stack([w[o[0], :, 0] * w[o[1], :, 1] * w[o[2], :, 2] for o in offsets])  # (27, N)
    nodes = base[None].long() + offsets[:, None]  # (27, N, 3)
    low = nodes.amin((0, 1))
    shape = nodes.amax((0, 1)) - low + 1
    index = nodes - low
    flat = ((index[..., 0] * shape[1] + index[..., 1]) * shape[2] + index[..., 2]).flatten()
    d = nodes.to(x.dtype) * spacing - x
    a = mass * affine - substep * volume * 4 / spacing**2 * tau
    momentum = weight[..., None] * (mass * v + (a[None] @ d[..., None])[..., 0])
    total = int(shape.prod())
    grid_m = torch.zeros(total, dtype=x.dtype).index_add(0, flat, (weight * mass).flatten())
    grid_p = torch.zeros(total, 3, dtype=x.dtype).index_add(0, flat, momentum.reshape(-1, 3))
    used = grid_m > 0
    grid_v = grid_p / torch.where(used, grid_m, 1)[:, None] + substep * torch.as_tensor(gravity, dtype=x.dtype)
    height = torch.arange(total) // shape[2] % shape[1] + low[1]
    below = (height <= 0)[:, None]
    if contact == "sticky":
        grid_v = torch.where(below, 0, grid_v)
    elif contact == "release":
        grid_v = torch.where(below & (grid_v[:, 1:2] < 0), 0, grid_v)
    elif contact == "slip":  # frictionless
        normal = torch.tensor([0.0, 1.0, 0.0], dtype=x.dtype)
        grid_v = torch.where(below & (grid_v[:, 1:2] < 0), grid_v * (1 - normal), grid_v)
    at_particle = weight[..., None] * grid_v[flat].reshape(27, -1, 3)
    v_new = at_particle.sum(0)
    c_new = 4 / spacing**2 * (at_particle[..., :, None] * d[..., None, :]).sum(0)
    return State(x + substep * v_new, v_new, c_new, f + substep * c_new @ f)
