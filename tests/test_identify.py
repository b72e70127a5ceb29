"""Initial motion, starting law and joint fit on trajectories simulated with a known law."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cube import FPS, FRAMES, GRAVITY, OMEGA, UP, VELOCITY, VOLUME, Seen, scene, settings
from scipy.spatial.transform import Rotation
from small import SMALL

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.starting_law import (
    DIVERGED,
    MAX_START_MODULUS,
    StartingLaw,
    choose_starting_laws,
    objective_of_start,
    rank_starting_laws,
)
from masiv.identification.stage import identify
from masiv.materials.load import load_law
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState, estimate_initial_motion
from masiv.pretraining.pretrain import pretrained_path
from masiv.progress import silent
from masiv.scene.scene import Ground
from masiv.simulation.simulate import simulate
from masiv.simulation.subdivide import merge_subparticles
from masiv.twin import Twin


def test_initial_motion_of_a_rigid_body(body):
    times = np.arange(6) / FPS
    centre = body.mean(0)
    path = np.stack([
        centre + VELOCITY * t + 0.5 * GRAVITY * t**2 + (body - centre) @ Rotation.from_rotvec(OMEGA * t).as_matrix().T
        for t in times
    ])  # fmt: skip
    initial_motion = estimate_initial_motion(path, times, GRAVITY, Ground(UP, -10.0), clearance=0.05)
    np.testing.assert_allclose(initial_motion.velocity, VELOCITY, atol=1e-5)
    np.testing.assert_allclose(initial_motion.omega, OMEGA, atol=1e-5)
    assert initial_motion.last_frame == 5
    # What follows the contact must not count.
    path[4:] = path[3]
    height = np.quantile(path[3] @ UP, 0.01) - 0.06
    late = estimate_initial_motion(path, times, GRAVITY, Ground(UP, height), clearance=0.08)
    np.testing.assert_allclose(late.velocity, VELOCITY, atol=1e-5)


def test_flight_ends_where_the_body_hits_what_nobody_declared(body):
    times = np.arange(8) / FPS
    path = body + VELOCITY * times[:, None, None] + 0.5 * GRAVITY * times[:, None, None] ** 2
    path[1:] += 1e-3 * np.random.default_rng(0).normal(size=path[1:].shape)
    free = estimate_initial_motion(path, times, GRAVITY, Ground(UP, -10.0), clearance=0.05)
    assert free.last_frame == 7
    for frame in (5, 6, 7):  # flattened, ever more
        path[frame, :, 1] = path[frame].mean(0)[1] + (1 - 0.1 * (frame - 4)) * (path[frame] - path[frame].mean(0))[:, 1]
    initial_motion = estimate_initial_motion(path, times, GRAVITY, Ground(UP, -10.0), clearance=0.05)
    assert initial_motion.last_frame == 4


def test_an_inelastic_starting_law_must_be_nearer_by_a_margin():
    """A yield stress that the motion does not reach cannot be identified; few particles do not show 5 %."""
    law = load_law(pretrained_path("jelly"))
    starts = {name: StartingLaw(name, "sticky", law, error) for name, error in (("plasticine", 17.4), ("jelly", 18.2))}
    assert [s.material for s in rank_starting_laws(list(starts.values()))] == ["jelly", "plasticine"]
    nearer = [
        StartingLaw("plasticine", "sticky", law, 15.0),
        starts["jelly"],
        StartingLaw("water", "sticky", law, 14.0),
    ]
    assert [s.material for s in rank_starting_laws(nearer)] == ["water", "plasticine", "jelly"]


def test_fit_explains_and_predicts_a_motion_it_was_not_told_the_law_of(seen):
    trajectory, positions = seen
    twin = identify(scene(), trajectory, settings(), SMALL)
    predicted = merge_subparticles(simulate(twin, frames=FRAMES + 4).positions, positions.shape[1])
    error = np.linalg.norm(predicted - positions, axis=2).mean(1)
    rigid = np.linalg.norm(positions[-1] - positions[0] - (positions[-1] - positions[0]).mean(0), axis=1).mean()
    assert twin.fit["trajectory_error_mm"] < 8
    assert error[FRAMES:].mean() < 0.025 < rigid
    np.testing.assert_allclose(twin.velocity, VELOCITY, atol=0.1)


def test_no_starting_law_is_stiffer_than_a_motion_determines(seen):
    problem = FilmedBody(scene(), seen[0], SMALL, samples=2, chosen=np.arange(0, len(seen[0].positions[0]), 4))
    motion = InitialState.of_world(problem.axes, VELOCITY, OMEGA)
    errors = [
        objective_of_start(Objective(problem, settings()), motion, "jelly", "sticky", factor * MAX_START_MODULUS)
        for factor in (0.5, 1.01)
    ]
    assert errors[0] < DIVERGED  # it could be simulated, and so could the stiffer one
    assert errors[1] == DIVERGED


def test_starting_laws_are_compared_until_the_body_is_at_rest(seen):
    """Rollouts of a motion, and of the same one after which the body lies still."""
    trajectory, law = seen[0], ("jelly", "sticky", 3e4)
    last = trajectory.positions[-1:]
    still = Seen(np.concatenate([trajectory.positions, *[last] * 5]), np.arange(FRAMES + 5) / FPS, VOLUME)
    creeps = still.positions.copy()
    creeps[FRAMES:, :, 1] -= 0.04 * np.arange(1, 6)[:, None]
    problems = [
        FilmedBody(replace(scene(), frame_count=len(one.times)), one, SMALL, samples=2)
        for one in (trajectory, still, Seen(creeps, still.times, VOLUME))
    ]
    assert [p.moving_frames for p in problems] == [FRAMES - 1, FRAMES - 1, FRAMES + 4]
    motion = InitialState.of_world(problems[0].axes, VELOCITY, OMEGA)
    short, rested, creeping = (objective_of_start(Objective(p, settings()), motion, *law) for p in problems)
    assert short == rested != creeping


def test_an_interrupted_search_for_the_starting_law_goes_on(seen, tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    def stop(*_):
        raise Stop

    monkeypatch.setattr("masiv.identification.neural.starting_law.START_MODULI", (1e4, 3e4))
    problem = FilmedBody(scene(), seen[0], SMALL, samples=2, chosen=np.arange(0, len(seen[0].positions[0]), 4))
    given = Objective(problem, settings()), InitialState.of_world(problem.axes, VELOCITY, OMEGA)
    (whole,) = choose_starting_laws(*given, silent)
    checkpoint, heard = Checkpoint(tmp_path / "identify.pt"), []
    with pytest.raises(Stop):
        choose_starting_laws(*given, stop, None, checkpoint)
    (resumed,) = choose_starting_laws(*given, lambda *told: heard.append(told), None, checkpoint)
    assert [told[1:3] for told in heard] == [(1, 1)]  # of the scales: the moduli were known
    assert resumed.objective == whole.objective
    assert all(torch.equal(value, resumed.law.state_dict()[name]) for name, value in whole.law.state_dict().items())


def test_interrupted_identify_ends_with_the_same_numbers(seen, tmp_path):
    class Stop(Exception):
        pass

    def stop_at_iteration_3(stage, done, total, note=""):
        if stage == "identify: fit" and done == 3:
            raise Stop

    config = settings(iterations=5)
    whole = identify(scene(), seen[0], config, SMALL)
    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(scene(), seen[0], config, SMALL, checkpoint=Checkpoint(path, every_s=0),
                 progress=stop_at_iteration_3)  # fmt: skip
    assert path.exists()
    resumed = identify(scene(), seen[0], config, SMALL, checkpoint=Checkpoint(path, every_s=0))
    assert np.array_equal(whole.velocity, resumed.velocity)
    assert whole.ground.height == resumed.ground.height
    for name, value in whole.law.state_dict().items():
        assert torch.equal(value, resumed.law.state_dict()[name])
    assert whole.fit == resumed.fit


def test_twin_survives_saving(seen, tmp_path):
    twin = identify(scene(), seen[0], settings(iterations=1), SMALL)
    twin.save(tmp_path)
    again = Twin.load(tmp_path)
    assert np.array_equal(simulate(twin, frames=4).positions, simulate(again, frames=4).positions)
    # A prediction starts from the identified motion, and what is asked for has an effect.
    rigid_initial_state = simulate(again, frames=2, velocity=np.array([1.0, 0.0, 0.0]), gravity=np.zeros(3))
    np.testing.assert_allclose(
        (rigid_initial_state.positions[1] - rigid_initial_state.positions[0]).mean(0) * FPS, [1.0, 0.0, 0.0], atol=1e-3
    )
    with pytest.raises(InputError, match="--velocity"):
        simulate(again, frames=2, velocity=np.array([np.nan, 0.0, 0.0]))
    (tmp_path / "twin.yaml").write_text("schema: 1\n")
    with pytest.raises(InputError, match="is not a twin"):
        Twin.load(tmp_path)
