"""Point clouds a frame: reading, the solid that they enclose, registration, and the whole job without a picture."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from cloud_scene import AXES, FPS, START, VOLUME, moved, surface, write_cloud, write_scene
from small import SMALL

from masiv.checkpoint import Checkpoint
from masiv.config import load_config
from masiv.continuum.cloud_volume import cloud_volume
from masiv.errors import InputError, MasivError
from masiv.observations.identity import identity
from masiv.observations.read import read_observation, read_scene
from masiv.progress import silent
from masiv.scene.cloud import Cloud
from masiv.scene.scene import Ground
from masiv.scene.summary import as_text, summarise
from masiv.splat.clouds import CloudLoss, centroid, even_subset

FRAMES = 5
TINY = {
    "reconstruct": {"gaussians": 600, "iterations": 300, "width": 32, "depth": 2, "processes": 1},
    "trajectory": {"particle_count": 500, "fill_resolution": 24, "iterations": 60},
    "simulator": SMALL.model_dump(exclude_defaults=True),
    "identify": {"start": "jelly", "contact": "sticky", "search_particles": 150, "iterations": 2, "processes": 1},
}


# ---- reading --------------------------------------------------------------------------------------------------------


def test_a_folder_of_clouds_is_a_scene(tmp_path):
    scene = read_scene(write_scene(tmp_path, 3, normals=True))
    assert (scene.layout, scene.fps, scene.frame_count, scene.cameras) == ("point clouds", FPS, 3, ())
    points, normals = surface(2500, 1)
    cloud = scene.cloud(1)
    np.testing.assert_allclose(cloud.points, points)
    assert cloud.normals is not None
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-12)
    summary = summarise(scene)
    json.dumps(summary)
    assert "2500 a frame" in as_text({**summary, "picture": "x.png"})
    with pytest.raises(InputError, match="frame 2"):
        scene.restricted(2).cloud(2)
    with pytest.raises(InputError, match="no cameras"):
        scene.restricted(2, (0,))


def test_colours_normals_and_crop_box(tmp_path):
    points, normals = surface(300, 0)
    for frame in range(2):
        write_cloud(tmp_path / f"{frame}.ply", points, 3 * normals, grey=51)
    low, high = START - np.ones(3), START + np.array([0, 1, 1])
    box = {"fps": 30, "crop_box": [low.tolist(), high.tolist()]}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(box))
    cloud = read_observation(tmp_path).cloud(0)  # type: ignore[union-attr]
    inside = points[:, 0] <= START[0]
    np.testing.assert_allclose(cloud.points, points[inside])
    np.testing.assert_allclose(cloud.normals, normals[inside], atol=1e-12)
    np.testing.assert_allclose(cloud.colours, 0.2)


def test_identity_covers_the_points(tmp_path):
    before = identity(read_scene(write_scene(tmp_path, 2)))
    points, _ = surface(2500, 1)
    points[7, 0] += 1e-6
    write_cloud(tmp_path / "cloud_1.ply", points)
    assert identity(read_scene(tmp_path)) != before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "cloud_1.ply").unlink(), "no point cloud of frame 1"),
        (lambda f: (f / "scene.yaml").unlink(), "must give fps"),
        (lambda f: (f / "scene.yaml").write_text("fps: 24\ndepth_unit: 0.001"), "depth_unit is for depth pictures"),
        (lambda f: (f / "scene.yaml").write_text("fps: 24\nfit_frames: 9"), "fit_frames is 9"),
        (lambda f: (f / "cloud_0.ply").write_text("ply\nnothing"), r"cloud_0\.ply is not a PLY file"),
        (lambda f: write_cloud(f / "cloud_0.ply", np.zeros((10, 3))), "a shape needs 50"),
        (lambda f: write_cloud(f / "cloud_0.ply", np.full((90, 3), np.nan)), "90 points are not finite"),
        (lambda f: write_cloud(f / "2.ply", np.zeros((90, 3))), "are both frame 2"),
        (lambda f: [(f / f"cloud_{k}.ply").unlink() for k in (1, 2)], "one frame only"),
    ],
)
def test_broken_clouds_are_one_clear_error(tmp_path, change, message):
    change(write_scene(tmp_path, 3, count=200))
    with pytest.raises(InputError, match=message):
        read_scene(tmp_path)


# ---- volume ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "noise"), [(1000, 0.0), (4000, 0.003), (15000, 0.003)])
def test_volume_inside_a_surface(count, noise):
    field = cloud_volume(Cloud(surface(count, 0, noise)[0]), 40, None, "it")
    assert field.volume == pytest.approx(VOLUME, rel=0.03)
    voxels = field.lower + field.spacing * np.argwhere(field.density > 0.5)
    np.testing.assert_allclose(voxels.mean(axis=0), START, atol=2e-3)


def test_volume_that_the_points_fill():
    unit = np.random.default_rng(0).uniform(-1, 1, (12000, 3))
    inside = START + AXES * unit[np.linalg.norm(unit, axis=1) < 1]
    field = cloud_volume(Cloud(inside), 40, None, "it")
    assert field.volume == pytest.approx(VOLUME, rel=0.1)
    assert field.inside(inside).mean() > 0.95


def test_a_cloud_may_be_open_at_the_ground_alone():
    points = surface(4000, 0)[0]
    height = START[1] - 0.5 * AXES[1]
    cut = points[points[:, 1] > height]
    ground = Ground(np.array([0.0, 1.0, 0.0]), float(height))
    cap = (2 - 3 * 0.5 + 0.5**3) / 4  # of a ball, cut at half its radius
    assert cloud_volume(Cloud(cut), 40, ground, "it").volume == pytest.approx(VOLUME * (1 - cap), rel=0.04)
    with pytest.raises(MasivError, match="the cloud encloses no volume"):
        cloud_volume(Cloud(cut), 40, None, "the cloud")


# ---- registration ---------------------------------------------------------------------------------------------------


def test_centroid_does_not_follow_the_density_of_points():
    points, _ = surface(4000, 0)
    dense = np.concatenate([points, np.repeat(points[points[:, 0] > START[0]], 9, axis=0)])
    assert np.linalg.norm(centroid(dense) - START) < 0.01
    assert np.linalg.norm(dense.mean(axis=0) - START) > 0.08


@pytest.mark.parametrize("count", [50, 700, 5000])
def test_even_subset(count):
    points, _ = surface(3000, 0)
    chosen = even_subset(points, count)
    assert 0.75 * min(count, 3000) <= len(chosen) <= count
    assert len(np.unique(chosen)) == len(chosen)


def test_loss_of_a_shifted_cloud_is_the_shift_across_the_surface():
    import torch

    flat = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [1, 1, 0]
    loss = CloudLoss.of(flat, None)
    up = torch.tensor(flat + np.array([0, 0, 0.05]), dtype=torch.float32)
    along = torch.tensor(flat * 0.9 + [0.02, 0, 0], dtype=torch.float32)  # other points of the same plane
    assert float(loss(up)) == pytest.approx(2 * 0.05, rel=0.1)
    assert float(loss(along)) < 0.1 * float(loss(up))


@pytest.fixture(scope="module")
def followed(tmp_path_factory, taichi):
    """The trajectory of the moving ellipsoid."""
    from masiv.continuum.trajectory import estimate_trajectory
    from masiv.splat.reconstruct import reconstruct

    folder = tmp_path_factory.mktemp("clouds")
    scene = read_scene(write_scene(folder / "scene", FRAMES, noise=1e-3))
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    config = load_config(path=folder / "tiny.yaml")
    dynamic = reconstruct(scene, config.reconstruct, seed=0, checkpoint=Checkpoint(None), progress=silent)
    return estimate_trajectory(scene, dynamic, config.trajectory)


def test_trajectory_tracks_the_truth(followed):
    trajectory = followed
    start = trajectory.positions[0].astype(float)
    for frame in range(1, FRAMES):
        error = np.linalg.norm(trajectory.positions[frame] - moved(start, frame), axis=1)
        assert error.mean() < 0.25 * trajectory.spacing
    last = moved(start, FRAMES - 1)
    turned = np.linalg.norm((last - last.mean(axis=0)) - (start - start.mean(axis=0)), axis=1)
    assert turned.mean() > 0.7 * trajectory.spacing  # a translation alone would not do
    assert trajectory.volume == pytest.approx(VOLUME, rel=0.05)


@pytest.mark.slow
def test_the_whole_job_without_a_picture(tmp_path, taichi):
    """inspect, identify with held-out frames, evaluate, simulate and the report."""
    from masiv.pipeline import Overrides, SceneRequest, SimulateRequest, inspect_scene, open_run, reopen_run, stages

    write_scene(tmp_path / "scene", 5, count=1500)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    assert "point clouds" in inspect_scene(tmp_path / "scene", tmp_path / "picture.png").text
    request, overrides = SceneRequest(fit_frames=4), Overrides(config=tmp_path / "tiny.yaml")
    run = open_run(tmp_path / "scene", tmp_path / "run", overrides, request)
    run.identify()
    page = (tmp_path / "run/report.html").read_text()
    assert "Point clouds, 5 frames" in page
    numbers = json.loads((tmp_path / "run/metrics.json").read_text())
    assert numbers["reconstruction"]["point_clouds"]["chamfer_1e3mm2"] < 1.0
    assert numbers["twin"]["future"]["frames"] == [4]
    (tmp_path / "gt").mkdir()
    inside = AXES * np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)) + START
    for frame in range(5):
        np.save(tmp_path / f"gt/particles_{frame}.npy", moved(inside, frame))
    again = reopen_run(tmp_path / "run")
    errors = again.evaluate(tmp_path / "gt").data["motion"]["trajectory"]["observed"]
    assert errors["tracked_error_mm"] < 10
    held_out = stages.ensure_held_out_trajectory(again.folder, again.config, read_scene(tmp_path / "scene"), silent)
    assert held_out is not None
    last = held_out.positions[4] - moved(held_out.positions[0].astype(float), 4)
    assert np.linalg.norm(last, axis=1).mean() < 1.0 * held_out.spacing
    again.simulate(SimulateRequest(frames=2), tmp_path / "out")
    assert (tmp_path / "out/rollout.npz").is_file()
    again.simulate(SimulateRequest(frames=2, render=True), tmp_path / "drawn")  # without cameras: from an orbit
    assert len(list((tmp_path / "drawn/views").glob("*.png"))) == 2
