"""Reconstruction of a small textured ball that falls and is squashed, drawn by the rasteriser's own float64 twin."""

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from textured_ball import FPS, FRAMES, SIDE, ball, camera_at

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError, MasivError
from masiv.progress import silent
from masiv.scene.scene import Frame, Scene
from masiv.splat._reference import _render
from masiv.splat.config import ReconstructConfig
from masiv.splat.data_parallel import GradientWorker, Networks
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.losses import neighbour_pairs, ssim, strain
from masiv.splat.objective import PARAMETER_NAMES, Objective, Part
from masiv.splat.observed_image import observed_image
from masiv.splat.rasteriser import render
from masiv.splat.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("taichi")

SPIN = np.array([0.03, 0.08, 0.05])  # rad a frame
CONFIG = ReconstructConfig(
    gaussians=250,
    hull_resolution=20,
    crop_side=40,
    crop_padding=4,
    width=16,
    depth=1,
    space_octaves=1,
    iterations=260,
    first_frame_fraction=0.4,
    growth_fraction=0.3,
    processes=1,
)


def truth(unit, frame):
    """It moves along x and down, faster and faster, and flattens."""
    squash = np.array([1 + 0.04 * frame, 1 - 0.07 * frame, 1 + 0.04 * frame])
    return 0.2 * unit * squash + np.array([0.03 * frame, 0.5 - 0.015 * frame**2, 0.0])


def spun(unit, frame):
    """It turns about an oblique axis, which its outline does not show, and moves along x."""
    turn = Rotation.from_rotvec(SPIN * frame)
    return 0.2 * turn.apply(unit) + np.array([0.03 * frame, 0.5, 0.0])


@pytest.fixture(scope="module")
def scene():
    return filmed(truth)


def filmed(where):
    """where(unit, frame): the points of the ball."""
    cameras = tuple(camera_at(2 * np.pi * k / 7, 0.2 + 0.3 * (k % 4)) for k in range(7))
    unit, colours = ball()
    size = torch.full((len(unit),), 0.016, dtype=torch.float64)

    def load(view, frame):
        points = torch.tensor(where(unit, frame))
        rgb, alpha, _ = _render(
            cameras[view], points, size, 0 * size + 0.95, torch.tensor(colours), torch.full((3,), 0.3).double()
        )
        return Frame(
            (rgb.clamp(0, 1) * 255).round().numpy().astype(np.uint8),
            (alpha > 0.5).float().numpy(),
            np.ones((SIDE, SIDE), bool),
        )

    return Scene(
        path=Path("ball"),
        layout="test",
        fps=FPS,
        frame_count=FRAMES,
        cameras=cameras,
        gravity=np.array([0, -9.8, 0]),
        up=np.array([0.0, 1.0, 0.0]),
        ground=None,
        density=1000.0,
        load=load,
        mask_source="test",
    )


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    """A run without interruption on six of the seven views."""
    return reconstruct(
        scene.restricted(holdout_cameras=(3,)), CONFIG, seed=4, checkpoint=Checkpoint(None), progress=silent
    )


class States(Checkpoint):
    """Keeps the base motion after each step."""

    def __init__(self):
        super().__init__(None)
        self.base_motions = []

    def maybe_save(self, state):
        self.base_motions.append(state()["network"]["base_motion"].clone())


@pytest.mark.slow
def test_frames_that_are_not_in_the_fit_yet_keep_the_base_motion_of_their_hulls():
    scene = dataclasses.replace(filmed(lambda unit, _: 0.2 * unit + np.array([0.0, 0.5, 0.0])), frame_count=30)
    config = CONFIG.model_copy(update={"iterations": 60, "first_frame_fraction": 0.1, "growth_fraction": 0.8})
    states = States()
    reconstruct(scene, config, seed=0, checkpoint=states, progress=silent)
    first, middle, last = states.base_motions[0], states.base_motions[30], states.base_motions[-1]
    assert torch.equal(middle[20:], first[20:])
    assert not torch.equal(middle[:10], first[:10])
    assert not torch.equal(last[20:], first[20:])


def test_adam_moves_the_base_motion_of_frames_without_images_unless_it_is_held():
    """Between frames, where a clock is late, the spline passes 0.27 of a gradient on from frame to frame, and Adam
    divides by the size of a gradient."""

    def moved(held):
        network = DeformationNetwork(
            centre=torch.zeros(3), half_extent=1.0, frame_count=60, fps=FPS, base_motion=torch.zeros(60, 3)
        )
        optimiser, rng = torch.optim.Adam([network.base_motion], lr=1e-3, eps=1e-15), np.random.default_rng(0)
        for _ in range(400):
            frame, seen = rng.integers(1, 10), torch.as_tensor(rng.normal(scale=0.01, size=3), dtype=torch.float32)
            optimiser.zero_grad()
            (network.base_displacements(torch.tensor([(frame + 0.1) / FPS])) - seen).square().sum().backward()
            if held:
                network.hold_base_motion(10)
            optimiser.step()
        return float(network.base_motion.detach()[20:].abs().max())

    assert moved(held=True) == 0.0
    assert moved(held=False) > 2e-3  # more than two steps


@pytest.mark.slow
def test_material_points_are_followed(result):
    unit, _ = ball()
    start = torch.tensor(truth(unit, 0)).float()
    for frame in (1, 2, 3):
        with torch.no_grad():
            moved = result.deformation(start, frame / FPS)[0].numpy()
        expected = truth(unit, frame) - truth(unit, 0)
        error = np.linalg.norm(moved - expected, axis=1).mean()
        assert error < 0.010 + 0.05 * np.linalg.norm(expected, axis=1).mean(), frame
        # Better than moving the whole ball: the flattening is seen too.
        assert frame < 3 or error < 0.8 * np.linalg.norm(expected - expected.mean(axis=0), axis=1).mean()


@pytest.mark.slow
def test_a_spin_that_no_outline_shows_is_followed():
    """From the first frame on: where points or colours may slide over the surface, half of it is lost there."""
    found = reconstruct(filmed(spun), CONFIG, seed=4, checkpoint=Checkpoint(None), progress=silent)
    unit, _ = ball()
    start = spun(unit, 0)
    with torch.no_grad():
        moved = start + found.deformation(torch.tensor(start).float(), 1 / FPS)[0].numpy()
    turn = Rotation.align_vectors(moved - moved.mean(0), unit)[0].as_rotvec()
    assert np.linalg.norm(turn - SPIN) < 0.3 * np.linalg.norm(SPIN)


@pytest.mark.slow
def test_a_view_held_out_is_predicted(scene, result):
    for frame in (0, 3):
        picture, camera = scene.frame(3, frame), scene.cameras[3]
        g = result.at(frame / FPS)
        drawn = render(camera, g.means, g.scales, g.opacities, g.colours, torch.zeros(3)).rgb.clamp(0, 1).numpy()
        target = picture.image / 255 * picture.mask[..., None]
        rows, columns = np.nonzero(picture.mask)
        box = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
        assert -10 * np.log10(((drawn - target)[box] ** 2).mean()) > 20, frame


@pytest.mark.slow
def test_resumed_run_ends_with_the_same_numbers(scene, result, tmp_path):
    part = scene.restricted(holdout_cameras=(3,))
    checkpoint = Checkpoint(tmp_path / "state.pt", every_s=0.0)

    def interrupt_at(step):
        def progress(stage, done, total, note=""):
            if done >= step:
                raise KeyboardInterrupt

        return progress

    # In the first frame's share, while frames come in, and after the first pruning with all of them in.
    for step in (20, 140, 230):
        with pytest.raises(KeyboardInterrupt):
            reconstruct(part, CONFIG, seed=4, checkpoint=checkpoint, progress=interrupt_at(step))
        assert checkpoint.load()["iteration"] == step
    again = reconstruct(part, CONFIG, seed=4, checkpoint=checkpoint, progress=silent)
    for name in ("means", "scales", "opacities", "colours"):
        assert torch.equal(getattr(again.canonical, name), getattr(result.canonical, name)), name
    for name, value in result.deformation.state_dict().items():
        assert torch.equal(value, again.deformation.state_dict()[name]), name
    assert same(again, result)


def same(one, other):
    for a, b in zip(one.calibration.refined, other.calibration.refined, strict=True):
        if not (np.array_equal(a.world_to_camera, b.world_to_camera) and np.array_equal(a.intrinsics, b.intrinsics)):
            return False
    if one.calibration.time_offsets != other.calibration.time_offsets:
        return False
    gaussians = ("means", "scales", "opacities", "colours")
    return all(torch.equal(getattr(one.canonical, n), getattr(other.canonical, n)) for n in gaussians) and all(
        torch.equal(value, other.deformation.state_dict()[n]) for n, value in one.deformation.state_dict().items()
    )


@pytest.mark.slow
def test_two_processes_end_with_the_numbers_of_one(scene, tmp_path):
    """Through frames that come in, pruning and a resume in the other number of processes."""
    one, two = (CONFIG.model_copy(update={"iterations": 60, "processes": n}) for n in (1, 2))
    whole = reconstruct(scene, one, seed=4, checkpoint=Checkpoint(None), progress=silent)
    checkpoint = Checkpoint(tmp_path / "state.pt", every_s=0.0)

    def interrupt(stage, done, total, note=""):
        if done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(scene, one, seed=4, checkpoint=checkpoint, progress=interrupt)
    assert checkpoint.load()["iteration"] == 40
    assert same(whole, reconstruct(scene, two, seed=4, checkpoint=checkpoint, progress=silent))
    assert same(whole, reconstruct(scene, two, seed=4, checkpoint=Checkpoint(None), progress=silent))


@pytest.mark.slow
def test_a_second_process_that_dies_is_told_of_and_none_is_left(scene, monkeypatch):
    started = []

    class Dies(GradientWorker):
        def __init__(self):
            super().__init__()
            started.append(self._process)

        def submit(self, *given, **options):
            if len(started) == 1:
                started.append(self._process.kill())
            super().submit(*given, **options)

    monkeypatch.setattr("masiv.splat.reconstruct.GradientWorker", Dies)
    config = CONFIG.model_copy(update={"iterations": 5, "processes": 2})
    with pytest.raises(MasivError, match=r"set reconstruct\.processes to 1"):
        reconstruct(scene, config, seed=4, checkpoint=Checkpoint(None), progress=silent)
    assert started[0].returncode is not None


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="the system does not show a process's environment")
def test_the_second_process_keeps_the_module_path_of_this_one(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/of/the/user")
    with GradientWorker() as worker:
        shown = Path(f"/proc/{worker._process.pid}/environ")
        # Popen returns before the kernel has set up the new program: until then the file is empty.
        while not (environment := shown.read_bytes()) and worker._process.poll() is None:
            time.sleep(0.001)
    assert b"PYTHONPATH=/of/the/user" in environment.split(b"\0")


@pytest.mark.slow
def test_what_the_second_process_cannot_draw_is_told_of(scene):
    """The picture that it is given has a camera of no number."""
    nowhere = dataclasses.replace(scene.cameras[0], world_to_camera=np.full((4, 4), np.nan))
    seen = dataclasses.replace(observed_image(scene, 0, 0, crop_side=40, crop_padding=4), camera=nowhere)
    objective = Objective(CONFIG, 0.01, 0.2, FPS, None, (), {})
    gaussians = {n: torch.zeros(4, *s) for n, s in zip(PARAMETER_NAMES, ((3,), (), (), (3,)), strict=True)}
    network = DeformationNetwork(
        centre=torch.zeros(3), half_extent=0.2, frame_count=2, fps=FPS, base_motion=torch.zeros(2, 3)
    )
    pairs = torch.zeros(1, dtype=torch.long), torch.ones(1, dtype=torch.long)
    part = Part(((0, seen, np.zeros(3)),), 1, (0,), 1, None, scale_term=True)
    with GradientWorker() as worker:
        worker.configure(objective, Networks(network), 4)
        for _ in range(2):  # it goes on
            worker.submit(gaussians, Networks(network), pairs, part, corrected=False)
            with pytest.raises(MasivError, match="not finite"):
                worker.result()
        process = worker._process
    assert process.returncode == 0


@pytest.mark.slow
def test_state_of_another_run_is_not_used(scene, tmp_path):
    short = CONFIG.model_copy(update={"iterations": 3})
    checkpoint = Checkpoint(tmp_path / "state.pt", every_s=0.0)
    first = reconstruct(scene, short, seed=1, checkpoint=checkpoint, progress=silent)
    fresh = reconstruct(scene, short, seed=2, checkpoint=Checkpoint(None), progress=silent)
    other = reconstruct(scene, short, seed=2, checkpoint=checkpoint, progress=silent)
    assert torch.equal(fresh.canonical.means, other.canonical.means)
    assert not torch.equal(first.canonical.means, other.canonical.means)


def test_only_what_may_be_seen_is_read(scene):
    asked = set()

    def load(view, frame):
        asked.add((view, frame))
        return scene.load(view, frame)

    part = dataclasses.replace(scene, load=load).restricted(fit_frames=2, holdout_cameras=(0, 5))
    reconstruct(part, CONFIG.model_copy(update={"iterations": 4}), seed=0, checkpoint=Checkpoint(None), progress=silent)
    assert asked == {(view, frame) for view in (1, 2, 3, 4, 6) for frame in (0, 1)}


def test_a_frame_without_the_object_is_named(scene):
    def load(view, frame):
        picture = scene.load(view, frame)
        return dataclasses.replace(picture, mask=picture.mask * (frame != 2))

    empty = dataclasses.replace(scene, load=load)
    with pytest.raises(MasivError, match=r"frame 2 of ball"):
        reconstruct(empty, CONFIG, seed=0, checkpoint=Checkpoint(None), progress=silent)


def test_result_round_trip(result, tmp_path):
    result.save(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "calibration.json",
        "deformation.safetensors",
        "gaussians.ply",
    ]
    again = DynamicGaussians.load(tmp_path)
    torch.testing.assert_close(again.at(0.1).means, result.at(0.1).means, atol=1e-6, rtol=0)
    torch.testing.assert_close(again.at(0.1).scales, result.at(0.1).scales, rtol=1e-4, atol=0)
    (tmp_path / "deformation.safetensors").unlink()
    with pytest.raises(InputError, match=r"deformation\.safetensors"):
        DynamicGaussians.load(tmp_path)


def test_averaged_crop_shows_the_same_points(scene):
    """Halving the picture halves the pixel coordinates, counted from the crop's corner."""
    whole = observed_image(scene, 1, 0, crop_side=40, crop_padding=3)
    half = observed_image(scene, 1, 0, crop_side=16, crop_padding=3)
    assert whole.colour.shape[:2] == (whole.camera.height, whole.camera.width)
    assert half.camera.width < whole.camera.width
    points = truth(ball(5)[0], 0)
    rays = [
        np.linalg.solve(o.camera.intrinsics, np.c_[o.camera.project(points)[0], np.ones(5)].T) for o in (whole, half)
    ]
    np.testing.assert_allclose(rays[0], rays[1], atol=1e-12)
    # The centre of mass of the mask is the same point of the scene in both.
    centres = []
    for o in (whole, half):
        rows, columns = np.mgrid[: o.camera.height, : o.camera.width] + 0.5
        weight = o.mask.numpy() / o.mask.numpy().sum()
        centres.append(np.linalg.solve(o.camera.intrinsics, [(columns * weight).sum(), (rows * weight).sum(), 1]))
    np.testing.assert_allclose(centres[0], centres[1], atol=2e-3)


def test_occluded_pixels_neither_count_nor_darken(scene):
    def load(view, frame):
        picture = scene.load(view, frame)
        valid = picture.valid.copy()
        valid[:, ::2] = False
        image = np.where(valid[..., None], picture.image, 0).astype(np.uint8)
        return Frame(image, picture.mask, valid)

    hidden = observed_image(dataclasses.replace(scene, load=load), 1, 0, crop_side=16, crop_padding=3)
    open_ = observed_image(scene, 1, 0, crop_side=16, crop_padding=3)
    inside = (open_.mask > 0.999) & (hidden.valid > 0)
    assert hidden.valid.max() < 0.8
    assert (hidden.colour - open_.colour)[inside].abs().mean() < 0.05


def test_ssim_and_strain_have_their_known_values():
    picture = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(0)).double()
    assert float(ssim(picture, picture)) == pytest.approx(1.0, abs=1e-12)
    flat = torch.full((20, 24, 3), 0.4).double()
    luminance = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert float(ssim(flat, flat + 0.2)) == pytest.approx(luminance, rel=1e-6)

    rest = torch.randn(30, 3, generator=torch.Generator().manual_seed(1)).double()
    pairs = torch.arange(0, 29), torch.arange(1, 30)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, 1.0, 0.2], [-1, 0, 0.5], [-0.2, -0.5, 0]]).double())
    assert float(strain(rest, rest @ turn.T + 3 - rest, *pairs, softening=0.0)) < 1e-10
    assert float(strain(rest, 0.1 * rest, *pairs, softening=0.0)) == pytest.approx(0.01, rel=1e-6)


def test_a_pair_of_neighbours_counts_for_each_of_the_two():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(2))
    moved = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(3))
    first, second, times = neighbour_pairs(points.double().numpy(), 6)
    assert (first < second).all()
    assert float(times.sum()) == 300
    nearest = torch.cdist(points, points).argsort(1)[:, 1:7]
    apart = torch.arange(50).repeat_interleave(6), nearest.flatten()
    one, other = (strain(points, moved, *p, softening=0.1) for p in ((first, second, times), apart))
    assert float(one) == pytest.approx(float(other), rel=1e-5)
