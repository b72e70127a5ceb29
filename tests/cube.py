"""A soft cube that is released, falls and lands, simulated with a known law: what fits of a motion are tested on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from ring_scene import look_at
from small import SMALL

from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.objective import Objective
from masiv.models.filmed_body import FilmedBody
from masiv.scene.scene import Frame, Ground, Scene
from masiv.simulation.simulate import simulate
from masiv.splat.rasteriser import render
from masiv.twin import Twin

GRAVITY = np.array([0.0, -9.8, 0.0])
UP = np.array([0.0, 1.0, 0.0])
GROUND = Ground(UP, 0.0)
FPS, FRAMES = 24.0, 9
VELOCITY, OMEGA = np.array([0.5, -1.0, 0.2]), np.array([1.0, 2.0, -1.0])
VOLUME = 0.064
SIDE = 48
"""Of a picture [px]."""


def no_picture(view, frame):
    raise AssertionError("this fit has no business with pictures")


def scene() -> Scene:
    return Scene(
        path=Path("simulated"), layout="none", fps=FPS, frame_count=FRAMES, cameras=(), gravity=GRAVITY, up=UP,
        ground=GROUND, density=1000.0, load=no_picture, mask_source="none",
    )  # fmt: skip


class Seen:
    """A trajectory known at the frames, linear between them."""

    def __init__(self, positions, times, volume):
        self.positions, self.times, self.volume = positions, times, volume
        self.volume_log_sd = float("nan")

    def evaluate(self, times):
        exact = np.asarray(times) * FPS
        low = np.clip(np.floor(exact).astype(int), 0, len(self.times) - 2)
        share = (exact - low)[:, None, None]
        return ((1 - share) * self.positions[low] + share * self.positions[low + 1]).astype(np.float32)


def particles() -> np.ndarray:
    """(343, 3) [m]."""
    axis = (np.arange(7) + 0.5) / 7 * 0.4
    x = np.stack(np.meshgrid(axis, axis + 0.15, axis, indexing="ij"), -1).reshape(-1, 3)
    return x.astype(np.float32)


def motion_of(law, frames, velocity=VELOCITY, omega=OMEGA):
    """The rollout of the cube with ``law``. Taichi must run."""
    truth = Twin.of_body(
        positions=particles(), velocity=velocity, omega=omega, gravity=GRAVITY, ground=GROUND, contact="sticky",
        friction=0.0, volume=VOLUME, density=1000.0, up=UP, fps=FPS, law=law, simulator=SMALL,
    )  # fmt: skip
    return simulate(truth, frames=frames)


def noisy(law) -> Seen:
    """The cube of ``law`` seen with noise of 1 mm."""
    motion = motion_of(law, FRAMES)
    noise = np.random.default_rng(0).normal(0, 1e-3, motion.positions.shape).astype(np.float32)
    noise[0] = 0
    return Seen(motion.positions + noise, motion.times, VOLUME)


def settings(**changes) -> IdentifyConfig:
    fast = dict(processes=1, start="jelly", contact="sticky", iterations=14, pictures=0, search_particles=200)
    return IdentifyConfig(**(fast | changes))


def silhouettes_of(positions) -> Scene:
    """``scene`` as four cameras see the motion ``positions`` (T, N, 3) [m]."""
    target = positions[4].mean(0).astype(float)
    angles = np.deg2rad([10, 100, 190, 280])
    cameras = tuple(
        look_at(f"{k}", target + 2.0 * np.array([np.cos(a), 0.4, np.sin(a)]), target, SIDE, 55.0)
        for k, a in enumerate(angles)
    )

    def load(view, frame):
        count = positions.shape[1]
        picture = render(cameras[view], torch.as_tensor(positions[frame]), torch.full((count,), 0.03),
                         torch.full((count,), 0.9), torch.zeros(count, 3), torch.zeros(3))  # fmt: skip
        mask = (picture.alpha.detach() > 0.5).float().numpy()
        return Frame(np.zeros((SIDE, SIDE, 3), np.uint8), mask, np.ones((SIDE, SIDE), bool))

    return dataclasses.replace(scene(), cameras=cameras, load=load, mask_source="alpha")


def objective_of(filmed, seen, **changes) -> Objective:
    config = settings(**{"pictures": 4, "iterations": 16, **changes})
    return Objective(FilmedBody(filmed, seen[0], SMALL, samples=config.samples_per_frame), config)
