"""Simulate the body of a spec, and carry its surface with its particles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from masiv.errors import InputError
from masiv.shapes import Solid
from masiv.synth.spec import SynthSpec

if TYPE_CHECKING:
    from masiv.effects.active import ActiveEffects

_PARTICLES_PER_CELL = 8
_COURANT = 0.25
_NEIGHBOURS = 16
MAX_SUBSTEPS = 20_000
"""In a frame: at 50 ms a substep that is a quarter of an hour, for a motion that nobody sees between two frames."""


def simulate(spec: SynthSpec, body: Solid) -> np.ndarray:
    """Positions (T, N, 3) float32 [m] of the body's particles at every frame.

    Frame 0 is the start, even if a clock effect acts. Needs ``masiv.runtime.start``. Raises InputError for an unusable
    law or effect, NonFiniteError if the simulation diverges.
    """
    import torch

    from masiv.materials.classical import ClassicalLaw
    from masiv.mpm.design import viscous_substep
    from masiv.mpm.rollout import at_rest
    from masiv.mpm.simulator import Simulator

    law = ClassicalLaw(spec.material.law, **spec.material.parameters)
    count = len(body.particles)
    spacing = (_PARTICLES_PER_CELL * body.volume / count) ** (1 / 3)
    position = torch.as_tensor(body.particles, dtype=torch.float32)
    effects = _effects(spec, position, body.volume)
    demand = effects.substep_demand()
    speed = math.sqrt((demand.modulus_factor * law.wave_modulus() + demand.modulus) / spec.material.density)
    fall = math.sqrt(np.square(spec.velocity).sum() + 2 * np.linalg.norm(spec.gravity) * spec.shape.clearance)
    diffusion = viscous_substep(
        spacing=spacing, density=spec.material.density, viscosity=demand.viscosity, courant_number=_COURANT
    )
    rate = max((speed + fall) / (_COURANT * spacing), 1 / diffusion)
    per_frame = max(1, math.ceil(rate / spec.fps))
    if per_frame > MAX_SUBSTEPS:
        raise InputError(
            f"a frame needs {per_frame:.3g} substeps, more than {MAX_SUBSTEPS}: give a softer or a heavier material, a "
            "larger fps, a lower speed or fewer particles"
        )
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
    raised = torch.tensor([0.0, float(effects.ground_shift()), 0.0])
    omega = torch.tensor(spec.omega, dtype=torch.float32)
    velocity = torch.tensor(spec.velocity) + torch.linalg.cross(omega.expand_as(position), position - position.mean(0))
    x, y, z = spec.omega
    spin = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float32)
    start = at_rest(position - raised, velocity.float(), spin.expand(count, 3, 3))
    # Instants of the frames in substeps; between two of these a particle moves in a straight line.
    instants = per_frame * (np.arange(1, spec.frames) + float(effects.time_shift()) * spec.fps)
    if instants[0] < 0:
        raise InputError(f"effects.time_offset puts frame 1 before the start: give more than {-1 / spec.fps:g} s")
    before = np.floor(instants).astype(int)
    share = torch.as_tensor(instants - before, dtype=torch.float32)[:, None, None]
    wanted = np.unique(np.concatenate([before, before + (instants > before)]))
    recording = simulator.run(start, law, int(wanted[-1]), wanted.tolist(), effects)
    at = recording.positions
    early = at[np.searchsorted(wanted, before)]
    late = at[np.searchsorted(wanted, before + (instants > before))]
    return torch.cat([position[None], torch.lerp(early, late, share) + raised]).numpy()


def _effects(spec: SynthSpec, rest, volume: float) -> ActiveEffects:
    """The effects of the spec for a body with particles ``rest`` (N, 3). Raises InputError for one that is unknown or
    lacks a place, a frequency…; strengths that are not given are zero."""
    import torch

    from masiv.effects.active import ActiveEffects
    from masiv.effects.catalogue import effect_named
    from masiv.effects.context import EffectContext

    members = []
    for name, given in spec.effects.items():
        effect = effect_named(name)
        known = [p.name for p in effect.parameters]
        for parameter in given:
            if parameter not in known:
                raise InputError(f"effects.{name}.{parameter}: {name} has no such parameter, use {', '.join(known)}")
        missing = [n for n in known[effect.strengths :] if n not in given]
        if missing or not given:
            raise InputError(f"effects.{name} lacks {', '.join(missing or known)}: give it a value")
        for p in effect.parameters:
            if p.name in given and not p.lower <= given[p.name] <= p.upper:
                raise InputError(f"effects.{name}.{p.name} is outside of {p.lower:g} to {p.upper:g} {p.unit}")
        members.append((effect, torch.tensor([given.get(n, 0.0) for n in known])))
    setting = EffectContext(
        gravity=torch.tensor(spec.gravity),
        rest=rest,
        particle_mass=spec.material.density * volume / len(rest),
        size=float((rest.amax(0) - rest.amin(0)).max()),
        duration=(spec.frames - 1) / spec.fps,
        frame_time=1 / spec.fps,
    )
    return ActiveEffects(tuple(members), setting)


class Skin:
    """Surface vertices (V, 3) [m] moved by particles (N, 3) [m], both at rest: each follows the affine map that fits
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
        # A sheet of neighbours does not determine the map across it: the added trace keeps it finite.
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
