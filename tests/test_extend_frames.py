"""A textured ball whose later frames a finished reconstruction has not seen: they are extended, the rest stays."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from textured_ball import FPS, SIDE, ball, camera_at

from masiv.checkpoint import Checkpoint
from masiv.config import Config
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.extend_trajectory import extend_trajectory
from masiv.continuum.trajectory import Trajectory, positions_at
from masiv.errors import InputError
from masiv.pipeline import stages
from masiv.runfolder import Request, RunFolder
from masiv.scene.scene import Frame, Scene
from masiv.splat._reference import _render
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.extend_frames import ExtendFramesConfig, extend_frames
from masiv.splat.gaussians import Gaussians

pytestmark = pytest.mark.usefixtures("taichi")

KNOWN, FRAMES, SIZE, CENTRE, HIDDEN_VIEW = 3, 6, 0.016, np.array([0.0, 0.5, 0.0]), 3
CONFIG = ReconstructConfig(
    gaussians=250, hull_resolution=20, crop_side=40, crop_padding=4, width=16, depth=1, space_octaves=1, iterations=120,
    processes=1,
)  # fmt: skip
EXTENSION = ExtendFramesConfig(step_ratio=1.0, pretrain_steps=150)
TRAJECTORY = TrajectoryConfig(fill_resolution=28, iterations=60, batch_size=300)


def truth(offset, frame):
    """Offsets (N, 3) [m] from the ball's centre -> displacement (N, 3): it drifts and, once not looked at, flattens."""
    late = max(0, frame - KNOWN + 1)
    drift = np.array([0.025 * frame, -0.01 * frame - 0.004 * late**2, 0.01 * late])
    return offset * np.array([0.04, -0.07, 0.04]) * late + drift


def surface():
    unit, colours = ball()
    return 0.2 * unit, colours


@pytest.fixture(scope="module")
def scene(taichi):
    """Seven views, one of which must not be looked at."""
    cameras = tuple(camera_at(2 * np.pi * k / 7, 0.2 + 0.3 * (k % 4)) for k in range(7))
    offset, colours = surface()
    size = torch.full((len(offset),), SIZE, dtype=torch.float64)

    def load(view, frame):
        assert view != HIDDEN_VIEW
        points = torch.tensor(CENTRE + offset + truth(offset, frame))
        rgb, alpha, _ = _render(
            cameras[view], points, size, 0 * size + 0.95, torch.tensor(colours), torch.full((3,), 0.3).double()
        )
        image = (rgb.clamp(0, 1) * 255).round().numpy().astype(np.uint8)
        return Frame(image, (alpha > 0.5).float().numpy(), np.ones((SIDE, SIDE), bool))

    up = np.array([0.0, 1.0, 0.0])
    whole = Scene(Path("ball"), "test", FPS, FRAMES, cameras, -9.8 * up, up, None, 1000.0, load, "test")
    return dataclasses.replace(whole, hidden_views=(HIDDEN_VIEW,))


@pytest.fixture(scope="module")
def fitted():
    """What a perfect fit of the known frames found: a drift, which a network that is still zero has as base motion."""
    offset, colours = surface()
    means = torch.tensor(CENTRE + offset).float()
    one = torch.ones(len(means))
    drift = np.stack([truth(np.zeros(3), frame) for frame in range(KNOWN)])
    torch.manual_seed(0)
    network = DeformationNetwork(
        centre=torch.tensor(CENTRE),
        half_extent=0.22,
        frame_count=KNOWN,
        fps=FPS,
        base_motion=torch.tensor(drift),
        width=16,
        depth=1,
        space_octaves=1,
    ).requires_grad_(False)
    return DynamicGaussians(Gaussians(means, SIZE * one, 0.95 * one, torch.tensor(colours).float()), network)


@pytest.fixture(scope="module")
def extended(scene, fitted):
    return extend_frames(scene, fitted, CONFIG, EXTENSION, seed=2)


@pytest.fixture(scope="module")
def particles(fitted):
    """A trajectory of the known frames: a lattice inside of the ball."""
    spacing = 0.04
    axis = np.arange(-5, 6) * spacing
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    offset = grid[np.linalg.norm(grid, axis=1) < 0.19]
    times = np.arange(KNOWN) / FPS
    positions = positions_at(fitted.deformation, CENTRE + offset, times)
    return Trajectory(positions, times, spacing, len(offset) * spacing**3, fitted.deformation)


def mean_error(moved, offset, frame):
    """[m], and what is left when the whole ball moves by the true mean."""
    expected = truth(offset, frame)
    error = np.linalg.norm(moved - expected, axis=1).mean()
    return error, np.linalg.norm(expected - expected.mean(axis=0), axis=1).mean()


def test_new_frames_are_followed_and_known_ones_stay(extended, fitted):
    offset, _ = surface()
    for name in ("means", "scales", "opacities", "colours"):
        assert torch.equal(getattr(extended.canonical, name), getattr(fitted.canonical, name))
    assert extended.deformation.frame_count == FRAMES
    for frame in range(FRAMES):
        with torch.no_grad():
            moved = extended.deformation(fitted.canonical.means, frame / FPS)[0].numpy()
        error, rigid = mean_error(moved, offset, frame)
        assert error < (0.002 if frame < KNOWN else 0.012), frame
        # Better than moving the whole ball: the flattening is seen too.
        assert frame < FRAMES - 1 or error < 0.5 * rigid


@pytest.mark.slow
def test_resumed_pass_ends_with_the_same_numbers(scene, fitted, extended, tmp_path):
    checkpoint = Checkpoint(tmp_path / "state.pt", every_s=0.0)

    def interrupt(stage, done, total, note=""):
        if done >= 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extend_frames(scene, fitted, CONFIG, EXTENSION, seed=2, checkpoint=checkpoint, progress=interrupt)
    assert checkpoint.load()["iteration"] == 50
    again = extend_frames(scene, fitted, CONFIG, EXTENSION, seed=2, checkpoint=checkpoint)
    for name, value in extended.deformation.state_dict().items():
        assert torch.equal(value, again.deformation.state_dict()[name]), name


def test_the_same_particles_go_on(scene, extended, particles):
    result = extend_trajectory(scene, extended, particles, TRAJECTORY, seed=1)
    assert result.positions.shape == (FRAMES, *particles.positions.shape[1:])
    np.testing.assert_array_equal(result.positions[:KNOWN], particles.positions)
    again = result.evaluate(result.times)
    assert np.linalg.norm(again[:KNOWN] - particles.positions, axis=-1).mean(axis=1).max() < 0.003
    np.testing.assert_allclose(again[KNOWN:], result.positions[KNOWN:], atol=1e-6)
    offset = particles.positions[0] - CENTRE
    for frame in range(KNOWN, FRAMES):
        error, _ = mean_error(result.positions[frame] - result.positions[0], offset, frame)
        assert error < 0.25 * particles.spacing, frame


def test_without_a_further_frame_there_is_nothing_to_follow(scene, fitted, extended, particles):
    with pytest.raises(InputError, match="beyond those that were fitted"):
        extend_frames(scene.restricted(KNOWN), fitted, CONFIG, EXTENSION, seed=0)
    with pytest.raises(InputError, match="more than the trajectory has"):
        extend_trajectory(scene, fitted, particles, TRAJECTORY)


@pytest.mark.slow
def test_a_run_measures_its_held_out_frames_once(scene, fitted, particles, tmp_path):
    quick, coarse = CONFIG.model_copy(update={"iterations": 20}), TRAJECTORY.model_copy(update={"iterations": 2})
    settings = Config(reconstruct=quick, trajectory=coarse)
    visible = dataclasses.replace(scene, hidden_views=())

    def run_of(name, fit_frames):
        request = Request(settings.model_dump(mode="json"), tmp_path, {}, fit_frames, (HIDDEN_VIEW,))
        return RunFolder.create_or_resume(tmp_path / name, request)

    assert stages.ensure_held_out_trajectory(run_of("all", FRAMES), settings, visible, lambda *_: None) is None
    run = run_of("part", KNOWN)
    for stage in ("reconstruct", "trajectory"):
        with run.stage(stage):
            fitted.save(run.path)
            particles.save(run.trajectory)
    first = stages.ensure_held_out_trajectory(run, settings, visible, lambda *_: None)
    assert first is not None
    assert len(first.positions) == FRAMES
    np.testing.assert_array_equal(first.positions[:KNOWN], particles.positions)
    made = {"gaussians.ply", "deformation.safetensors", "trajectory.npz"}
    assert {path.name for path in (run.path / "held_out").iterdir()} == made
    assert not list(run.path.glob("checkpoints/*"))

    def work(*_):
        raise AssertionError("made again")

    again = stages.ensure_held_out_trajectory(run, settings, visible, work)
    assert again is not None
    np.testing.assert_array_equal(again.positions, first.positions)
