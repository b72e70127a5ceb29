"""A recording of the body, as the fit of a law uses it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from masiv.continuum.trajectory import Trajectory
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.objective import Objective
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialMotion, InitialState, estimate_initial_motion
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class FitRecording:
    """The objective of a recording, the initial state from which its fit starts, and the number of frames of the first
    iterations."""

    objective: Objective
    initial_state: InitialState
    first_frames: int

    @cached_property
    def frames(self) -> int:
        """Frames after frame 0 that the fit simulates: those until the observed body is at rest, and as many at rest.

        More frames at rest would outweigh the motion, show one shape again and again, and make the gradient long; with
        none, a fit hardly sees the shape in which the body ends.
        """
        problem = self.objective.problem
        return min(problem.frames, 2 * problem.moving_frames)


def prepare_recording(
    scene: Scene, trajectory: Trajectory, config: IdentifyConfig, simulator: SimulatorConfig
) -> tuple[FitRecording, InitialMotion]:
    """A recording whose fit starts with the initial motion of its free flight, over those frames and one more."""
    problem = FilmedBody(scene, trajectory, simulator, samples=config.samples_per_frame)
    motion = estimate_initial_motion(
        trajectory.positions, trajectory.times, scene.gravity, scene.ground, clearance=problem.spacing
    )
    initial_state = InitialState.of_world(problem.axes, motion.velocity, motion.omega)
    first_frames = min(motion.last_frame + 2, problem.frames)
    return FitRecording(Objective.of(problem, trajectory, config), initial_state, first_frames), motion
