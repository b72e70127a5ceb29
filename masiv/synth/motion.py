"""Simulate the body of a spec, and carry its surface with its particles."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from masiv.synth.shapes import Body
from masiv.synth.spec import SynthSpec

_PARTICLES_PER_CELL = 8
_COURANT = 0.25
_NEIGHBOURS = 16


def simulate(spec: SynthSpec, body: Body) -> np.ndarray:
    """Positions (T, N, 3) float32 [m] of the body's particles at every frame.

    Needs ``masiv.runtime.start``. Raises InputError for an unusable law, NonFiniteError where the simulation blows up.
    """
    import torch

    from masiv.materials.classical import ClassicalLaw
    from masiv.mpm.rollout import at_rest
    from masiv.mpm.simulator import Simulator

    law = ClassicalLaw(spec.material.law, **spec.material.parameters)
    count = len(body.particles)
    spacing = (_PARTICLES_PER_CELL * body.volume / count) ** (1 / 3)
    speed = math.sqrt(law.wave_modulus() / spec.material.density)
    fall = math.sqrt(np.square(spec.velocity).sum() + 2 * np.linalg.norm(spec.gravity) * spec.shape.clearance)
    per_frame = max(1, math.ceil((speed + fall) / (_COURANT * spacing * spec.fps)))
    simulator = Simulator(
        particle_count=count,
        spacing=spacing,
        substep=1 / (spec.fps * per_frame),
        volume=body.volume,
        density=spec.material.density,
        gravity=spec.gravity,
        contact=spec.contact,
        friction=spec.friction,
        memory_mb=250,
        grid_nodes=1 << 20,
    )
    position = torch.as_tensor(body.particles, dtype=torch.float32)
    omega = torch.tensor(spec.omega, dtype=torch.float32)
    velocity = torch.tensor(spec.velocity) + torch.linalg.cross(omega.expand_as(position), position - position.mean(0))
    x, y, z = spec.omega
    spin = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float32)
    start = at_rest(position, velocity.float(), spin.expand(count, 3, 3))
    steps = per_frame * (spec.frames - 1)
    recording = simulator.run(start, law, steps, [k * per_frame for k in range(spec.frames)])
    return recording.positions.numpy()


class Skin:
    """Surface vertices (V, 3) [m] carried by particles (N, 3) [m], both at rest: each follows the affine map that fits
    best, in weighted least squares, how its nearest particles move."""

    def __init__(self, vertices: np.ndarray, particles: np.ndarray) -> None:
        distance, self.neighbours = cKDTree(particles).query(vertices, k=_NEIGHBOURS)
        weight = np.exp(-0.5 * (distance / distance[:, _NEIGHBOURS // 2 :].mean(axis=1, keepdims=True)) ** 2)
        self.weight = weight / weight.sum(axis=1, keepdims=True)
        around = particles[self.neighbours]
        self.middle = self._mean(around)
        self.arm = vertices - self.middle
        self.offsets = around - self.middle[:, None]
        inertia = np.einsum("vk,vki,vkj->vij", self.weight, self.offsets, self.offsets)
        # A sheet of neighbours says nothing across itself: the added trace keeps the map finite there.
        inertia += 1e-3 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        self.inverse = np.linalg.inv(inertia)
        self.slack = np.eye(3) - np.einsum("vk,vki,vkj,vjl->vil", self.weight, self.offsets, self.offsets, self.inverse)

    def _mean(self, around: np.ndarray) -> np.ndarray:
        return np.einsum("vk,vki->vi", self.weight, around)

    def at(self, particles: np.ndarray) -> np.ndarray:
        """The vertices (V, 3) [m] when the particles are at (N, 3) [m]."""
        around = particles[self.neighbours]
        middle = self._mean(around)
        affine = np.einsum("vk,vki,vkj,vjl->vil", self.weight, around - middle[:, None], self.offsets, self.inverse)
        return middle + np.einsum("vij,vj->vi", affine + self.slack, self.arm)
