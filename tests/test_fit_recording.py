"""The frames that a fit simulates."""

import pytest
from cube import objective_of, scene

from masiv.identification.recording import FitRecording
from masiv.models.initial_state import InitialState


@pytest.mark.parametrize(("moving", "frames"), [(3, 6), (5, 8), (8, 8)])
def test_a_fit_sees_as_many_frames_at_rest_as_in_motion(seen, moving, frames):
    objective = objective_of(scene(), seen, samples_per_frame=1)
    problem = objective.problem
    problem.targets = problem.targets.clone()
    problem.targets[moving - 1 :] = problem.targets[-1] + problem.size  # a jump is the last motion
    recording = FitRecording(objective, InitialState.of_world(problem.axes, [0.0] * 3, [0.0] * 3), 1)
    assert problem.frames == 8
    assert problem.moving_frames == moving
    assert recording.frames == frames
