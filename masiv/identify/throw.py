"""One throw of the body, as a fit begins with it."""

from __future__ import annotations

from dataclasses import dataclass

from masiv.continuum.trajectory import Trajectory
from masiv.identify.config import IdentifyConfig
from masiv.identify.problem import Problem
from masiv.models.initial_state import InitialMotion, InitialState, estimate_initial_motion
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Throw:
    """problem: rollouts of the throw beside what was observed. motion: where its fit begins; first_frames: how many
    frames the fit begins with."""

    problem: Problem
    motion: InitialState
    first_frames: int


def throw_of(
    scene: Scene, trajectory: Trajectory, config: IdentifyConfig, simulator: SimulatorConfig
) -> tuple[Throw, InitialMotion]:
    """A throw that begins with the motion of its free flight, and with the frames of that and one more."""
    problem = Problem(scene, trajectory, config, simulator)
    initial_motion = estimate_initial_motion(
        trajectory.positions, trajectory.times, scene.gravity, scene.ground, clearance=problem.spacing
    )
    motion = InitialState.of_world(problem.axes, initial_motion.velocity, initial_motion.omega)
    return Throw(problem, motion, min(initial_motion.last_frame + 2, problem.frames)), initial_motion
