"""One throw of the body, as a fit begins with it."""

from __future__ import annotations

from dataclasses import dataclass

from masiv.continuum.trajectory import Trajectory
from masiv.identify.config import IdentifyConfig
from masiv.identify.launch import Launch, estimate_launch
from masiv.identify.problem import Motion, Problem
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Throw:
    """problem: rollouts of the throw beside what was observed. motion: where its fit begins; first_frames: how many
    frames the fit begins with."""

    problem: Problem
    motion: Motion
    first_frames: int


def throw_of(
    scene: Scene, trajectory: Trajectory, config: IdentifyConfig, simulator: SimulatorConfig
) -> tuple[Throw, Launch]:
    """A throw that begins with the motion of its free flight, and with the frames of that and one more."""
    problem = Problem(scene, trajectory, config, simulator)
    launch = estimate_launch(
        trajectory.positions, trajectory.times, scene.gravity, scene.ground, clearance=problem.spacing
    )
    motion = Motion.of_world(problem.axes, launch.velocity, launch.omega)
    return Throw(problem, motion, min(launch.last_frame + 2, problem.frames)), launch
