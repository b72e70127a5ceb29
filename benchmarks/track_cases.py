"""Throws of simulated bodies with one undeclared effect, as tracks with correlated noise: cases for refine.

The motion is simulated with more particles on a finer grid than any model of it, which with six particles a cell is the
grid of the twin that sigma looks at, too (``per_cell`` makes it another); noise is smooth in space and time.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from unknown_effects import UNKNOWN

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.materials.classical import ClassicalLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import substeps_per_frame
from masiv.mpm.rollout import rollout
from masiv.mpm.simulator import Simulator
from masiv.observations.motion import SampledMotion
from masiv.scene.scene import Ground, Scene
from masiv.shapes import ShapeSpec, make_body

FPS = 24.0


SHAPE = ShapeSpec(kind="capsule", size=0.5, rotation_deg=(20.0, 0.0, 35.0), clearance=0.35)


@dataclass(frozen=True)
class Case:
    """effects: {name: {parameter: value}}, what the model does not know. outside: the same of
    ``unknown_effects``, which no library has."""

    name: str
    law: str
    parameters: dict[str, float]
    effects: dict[str, dict[str, float]]
    shape: ShapeSpec = SHAPE
    velocity: tuple[float, float, float] = (1.2, 0.4, 0.3)
    omega: tuple[float, float, float] = (0.0, 2.0, 3.0)
    frames: int = 16
    fit_frames: int = 12
    particles: int = 4000
    per_cell: float = 6.0
    noise_mm: float = 2.0
    seed: int = 0
    contact: str = "sticky"
    outside: dict[str, dict[str, float]] = field(default_factory=dict)


def observed(case: Case) -> tuple[Scene, SampledMotion]:
    """The scene (no pictures) and the noisy motion of all frames."""
    body = make_body(case.shape, case.particles)
    start = torch.as_tensor(body.particles, dtype=torch.float32)
    law = ClassicalLaw(case.law, **case.parameters)
    count = len(start)
    spacing = (case.per_cell * body.volume / count) ** (1 / 3)
    size = float((start - start.mean(0)).norm(dim=1).quantile(0.9)) * 2
    setting = EffectContext(torch.tensor([0.0, -9.8, 0.0]), start, 1000 * body.volume / count, size, case.frames / FPS)
    members, late = [], 0.0
    for name, values in case.effects.items():
        effect = effect_named(name)
        members.append((effect, torch.tensor([values[p.name] for p in effect.parameters])))
    for name, values in case.outside.items():
        effect = UNKNOWN[name]
        members.append((effect, torch.tensor([values[p.name] for p in effect.parameters])))
    active = ActiveEffects(tuple(members), setting)
    needed = substeps_per_frame(
        spacing=spacing, wave_modulus=law.wave_modulus(), density=1000.0, speed=5.0, frame_time=1 / FPS,
        config=SimulatorConfig.model_validate({"max_substeps_per_frame": 1 << 16}), demand=active.substep_demand(),
    )  # fmt: skip
    steps = -(-needed // 8) * 8
    simulator = Simulator(particle_count=count, spacing=spacing, substep=1 / (FPS * steps), volume=body.volume,
                          density=1000.0, gravity=(0.0, -9.8, 0.0), contact=case.contact, max_substeps=512)  # fmt: skip
    raised, late = float(active.ground_shift()), round(float(active.time_shift()) * FPS * steps)
    shift = torch.tensor([0.0, raised, 0.0])
    state = rigid_initial_state(start - shift, torch.tensor(case.velocity), torch.tensor(case.omega))
    outputs = [k * steps + late for k in range(1, case.frames)]
    with torch.no_grad():
        moved = rollout(simulator, law, state, outputs[-1], outputs, active) + shift
    exact = np.concatenate([start[None].numpy(), moved.numpy()]).astype(np.float64)
    noisy = exact + smooth_noise(exact[0], case.frames, 1e-3 * case.noise_mm, case.seed)
    noisy[0] = exact[0]
    scene = Scene(path=Path(case.name), layout="tracks", fps=FPS, frame_count=case.frames, cameras=(),
                  gravity=np.array([0.0, -9.8, 0.0]), up=np.array([0.0, 1.0, 0.0]),
                  ground=Ground(np.array([0.0, 1.0, 0.0]), 0.0), density=1000.0, load=_no_pictures,
                  mask_source="none")  # fmt: skip
    return scene, SampledMotion(noisy, np.arange(case.frames) / FPS, body.volume)


def _no_pictures(view: int, frame: int):
    raise LookupError(f"tracks have no pictures (view {view}, frame {frame})")


def smooth_noise(points: np.ndarray, frames: int, deviation: float, seed: int) -> np.ndarray:
    """(T, N, 3) [m] of standard deviation ``deviation`` a coordinate, correlated over 0.15 m and 2.5 frames."""
    random = np.random.default_rng(seed)
    waves = 64
    wave = random.normal(size=(waves, 3)) / 0.15
    rate = random.normal(size=waves) / 2.5
    phase = random.uniform(0, 2 * np.pi, waves)
    direction = random.normal(size=(waves, 3)) / np.sqrt(waves) * np.sqrt(2)
    angle = (points @ wave.T)[None] + np.arange(frames)[:, None, None] * rate + phase
    return deviation * np.cos(angle) @ direction


def replaced(case: Case, **changes) -> Case:
    return dataclasses.replace(case, **changes)
