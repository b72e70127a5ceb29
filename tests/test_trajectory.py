from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ring_scene import spheres_scene
from still import still

from masiv.checkpoint import Checkpoint
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.consistency import images_against
from masiv.continuum.fill import FilledVolume
from masiv.continuum.finetune import chamfer_targets
from masiv.continuum.losses import below_ground, field_terms, load_views, outside_of_mask, stencil
from masiv.continuum.trajectory import Trajectory, estimate_trajectory
from masiv.errors import InputError
from masiv.hull.symmetry import MirrorPlane
from masiv.scene.scene import Ground

RADIUS, SHIFT = 0.22, np.array([0.06, -0.02, 0.03])
CONFIG = TrajectoryConfig(
    particle_count=600,
    fill_resolution=32,
    iterations=60,
    learning_rate=1e-2,
    batch_size=300,
    match_interval=5,
    motion_weight=0,
)


def moving(frame: int) -> list:
    """A ball that drifts by SHIFT a frame."""
    return [(np.array([0.0, 0.5, 0.0]) + frame * SHIFT, RADIUS)]


@pytest.fixture
def scene():
    return spheres_scene(moving)


@pytest.fixture
def dynamic():
    """A reconstruction that missed the motion: everything stands still."""
    torch.manual_seed(0)
    return still(np.random.default_rng(0).normal(size=(50, 3)) * 0.1 + [0, 0.5, 0], 0.0)


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch):
    """The Gaussians of these tests are no surface: let them carve nothing."""
    monkeypatch.setattr(
        "masiv.continuum.fill.surface_depth", lambda dynamic, camera, time: np.zeros((camera.height, camera.width))
    )


def lattice(count: int = 6, spacing: float = 0.1) -> np.ndarray:
    axis = np.arange(count) * spacing
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


@pytest.mark.slow
def test_a_missed_motion_is_found(scene, dynamic, monkeypatch):
    # The still motion contradicts the masks; what is tested here is the fine-tuning.
    monkeypatch.setattr("masiv.continuum.trajectory.images_against", lambda s, n, p, *_: np.zeros(len(p), int))
    result = estimate_trajectory(scene, dynamic, CONFIG.model_copy(update={"iterations": 250}), seed=1)
    assert result.positions.dtype == np.float32
    assert result.positions.shape[0] == scene.frame_count
    drift = result.positions - result.positions[0]
    expected = np.arange(4)[:, None, None] * SHIFT
    # A uniform translation is the smoothest motion that fills the volumes: half a spacing is all that sampling allows.
    assert np.linalg.norm(drift - expected, axis=-1).mean() < 0.35 * result.spacing
    assert result.volume == pytest.approx(len(result.positions[0]) * result.spacing**3)


def test_first_frame_is_anchored_and_frames_agree_with_evaluate(scene, dynamic):
    result = estimate_trajectory(scene, dynamic, CONFIG.model_copy(update={"carve_images": 99, "iterations": 5}))
    np.testing.assert_array_equal(result.evaluate(np.array([0.0]))[0], result.positions[0])
    np.testing.assert_allclose(result.evaluate(result.times), result.positions, atol=1e-6)
    between = result.evaluate(np.linspace(0, result.times[-1], 31))
    assert np.linalg.norm(np.diff(between, axis=0), axis=-1).max() < 0.05


@pytest.mark.slow
def test_interrupted_and_resumed_is_uninterrupted(scene, dynamic, tmp_path):
    config = CONFIG.model_copy(update={"carve_images": 99, "iterations": 20})
    whole = estimate_trajectory(scene, dynamic, config, seed=3)

    class Killed(Exception):
        pass

    def kill(stage: str, done: int, total: int, note: str = "") -> None:
        if stage == "trajectory" and done == 13:
            raise Killed

    checkpoint = Checkpoint(tmp_path / "state.pt", every_s=0.0)
    with pytest.raises(Killed):
        estimate_trajectory(scene, dynamic, config, seed=3, checkpoint=checkpoint, progress=kill)
    assert checkpoint.load()["iteration"] == 10
    resumed = estimate_trajectory(scene, dynamic, config, seed=3, checkpoint=checkpoint)
    np.testing.assert_array_equal(resumed.positions, whole.positions)
    other = estimate_trajectory(scene, dynamic, config, seed=4)
    assert not np.array_equal(other.positions, whole.positions)


@pytest.mark.slow
def test_saved_trajectory_evaluates_alone(scene, dynamic, tmp_path):
    result = estimate_trajectory(scene, dynamic, CONFIG.model_copy(update={"carve_images": 99, "iterations": 10}))
    result = replace(result, mirror=MirrorPlane(np.array([0.0, 0.6, 0.8]), 0.1))
    result.save(tmp_path / "trajectory.npz")
    loaded = Trajectory.load(tmp_path / "trajectory.npz")
    times = np.array([0.01, 0.055])
    np.testing.assert_array_equal(loaded.evaluate(times), result.evaluate(times))
    assert (loaded.spacing, loaded.volume) == (result.spacing, result.volume)
    assert str(loaded.mirror) == "mirror plane (0.000, 0.600, 0.800)·x = 0.1000 m"
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.npz"]
    (tmp_path / "broken.npz").write_bytes(b"PK not a zip")
    with pytest.raises(InputError, match=r"broken\.npz"):
        Trajectory.load(tmp_path / "broken.npz")


def test_targets_have_the_gradient_of_chamfer():
    """Against autograd through the Chamfer distance itself, pairs all farther than the sampling noise."""
    rng = np.random.default_rng(0)
    moved, target = rng.normal(size=(1, 30, 3)), rng.normal(size=(20, 3)) + 4.0
    start = FilledVolume(moved[0], 1e-3, 1.0)
    targets = chamfer_targets(moved, [FilledVolume(target, 1e-3, 1.0)], start)
    x = torch.tensor(moved[0], requires_grad=True)
    square = torch.cdist(x, torch.tensor(target)).square()
    (square.min(1).values.mean() + square.min(0).values.mean()).backward()
    ours = 2 * targets.weights[0][:, None].double() * (torch.tensor(moved[0]) - targets.targets[0].double())
    torch.testing.assert_close(ours, x.grad, rtol=1e-4, atol=1e-6)


def test_a_second_sampling_of_the_same_volume_has_no_weight():
    start = FilledVolume(lattice(), 0.1, 216e-3)
    shifted = FilledVolume(lattice() + 0.03, 0.1, 216e-3)
    assert float(chamfer_targets(lattice()[None], [shifted], start).weights.sum()) == 0


def test_shadow_volume_of_the_hull_has_no_weight():
    """A filled volume twice the body's: of the half that is far away, the tenth that is slack pulls and no more."""
    start = FilledVolume(lattice(), 0.1, 216e-3)
    spike = np.concatenate([lattice(), lattice() + np.array([3.0, 0, 0])])
    assert float(chamfer_targets(lattice()[None], [FilledVolume(spike, 0.1, 432e-3)], start).weights.sum()) < 0.11 / 2


@pytest.mark.parametrize("kind", ["translation", "rotation", "stretch"])
def test_field_terms_of_known_motions(kind):
    centres = torch.rand(20, 3, dtype=torch.float64)
    points = stencil(centres, 0.01)
    gradient = {
        "translation": torch.eye(3),
        "rotation": torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]]),
        "stretch": torch.diag(torch.tensor([1.2, 1.0, 1.0])),
    }[kind].double()
    moved = points @ gradient.T + 0.3
    terms = {name: float(value) for name, value in field_terms((moved - points)[None], 0.01).items()}
    strained = kind == "stretch"
    assert terms["smoothness"] == pytest.approx(0, abs=1e-12)
    assert terms["volume"] == pytest.approx(0.04 if strained else 0, abs=1e-6)
    assert terms["rigidity"] == pytest.approx(0.44**2 if strained else 0, abs=1e-6)


def test_outside_of_mask_matches_the_ball_and_its_gradient_leads_back(scene):
    view = load_views(scene)[0][2]
    camera = scene.cameras[2]
    right = camera.world_to_camera[0, :3]
    centre = moving(0)[0][0]
    away = torch.tensor(np.stack([centre, centre + 0.32 * right]), dtype=torch.float32, requires_grad=True)
    outside = outside_of_mask(away, view)
    assert outside[0] == 0
    assert outside[1].item() == pytest.approx(0.10, abs=0.015)
    outside.sum().backward()
    assert float(away.grad[1] @ torch.tensor(right, dtype=torch.float32)) == pytest.approx(1.0, abs=0.15)


def test_below_ground():
    ground = Ground(np.array([0.0, 1.0, 0.0]), 0.1)
    torch.testing.assert_close(
        below_ground(torch.tensor([[0.0, 0.3, 0], [5, -0.2, 1]]), ground), torch.tensor([0.0, 0.3])
    )


def test_what_leaves_the_masks_or_the_world_is_carved(scene, dynamic):
    """Nothing moves, but the ball drifts away: its trailing side leaves the masks, the leading one stays."""
    centre = moving(0)[0][0]
    along = SHIFT / np.linalg.norm(SHIFT)
    probes = np.stack([centre - 0.18 * along, centre + 0.1 * along])
    config = CONFIG.model_copy(update={"carve_tolerance": 1.5, "carve_images": 3})
    against = images_against(scene, dynamic.deformation, probes, config)
    assert (against < config.carve_images).tolist() == [False, True]
