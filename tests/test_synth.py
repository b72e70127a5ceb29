from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from ring_scene import look_at, pixel_rays

from masiv.errors import InputError
from masiv.observations.read import read_scene
from masiv.shapes import ShapeSpec, make_body
from masiv.synth.motion import Skin, simulate
from masiv.synth.picture import rasterise
from masiv.synth.spec import SynthSpec, read_spec
from masiv.synth.synthesise import synthesise
from masiv.synth.texture import solid_color

SMALL = {
    "shape": {"kind": "sphere", "size": 0.4, "clearance": 0.3},
    "velocity": [0.5, 0.2, 0.0],
    "omega": [0.0, 3.0, 0.0],
    "frames": 3,
    "cameras": {"count": 3, "size": 48},
    "particles": 600,
    "truth_particles": 200,
    "supersampling": 2,
}


@pytest.fixture(scope="module")
def scene_folder(taichi, tmp_path_factory):
    out = tmp_path_factory.mktemp("synth") / "scene"
    synthesise(SynthSpec.model_validate(SMALL), out)
    return out


def test_scene_is_read_as_it_was_made(scene_folder):
    scene = read_scene(scene_folder)
    assert (scene.layout, scene.frame_count, len(scene.cameras), scene.fps) == ("pacnerf", 3, 3, pytest.approx(24.0))
    assert not scene.problems
    truth = yaml.safe_load((scene_folder / "truth.yaml").read_text())
    assert truth["material"]["law"] == "neo_hookean"
    assert len(json.loads((scene_folder / "all_data.json").read_text())) == 3 * 4


def test_a_plain_body_shows_no_texture_and_a_weak_one_a_part_of_it():
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    for kind in ("noise", "stripes", "patches"):
        full, weak, plain = (solid_color(kind, places, 3, contrast) for contrast in (1.0, 0.2, 0.0))
        np.testing.assert_allclose(weak - plain, 0.2 * (full - plain))
        assert np.ptp(plain, axis=0).max() < 1e-12
        assert full.std() > 0.1


def test_compressed_pictures_differ_a_little_and_stay_below_the_white_of_masks(scene_folder, tmp_path):
    rough = SynthSpec.model_validate({**SMALL, "frames": 2, "jpeg_quality": 50})
    synthesise(rough, tmp_path / "rough")
    clean, compressed = (
        cv2.imread(str(folder / "data/r_0_0.png")).astype(int) for folder in (scene_folder, tmp_path / "rough")
    )
    assert 0.5 < np.abs(clean - compressed).mean() < 12
    assert np.corrcoef(clean.ravel(), compressed.ravel())[0, 1] > 0.97
    assert compressed.max() <= 254


def test_particles_project_onto_the_masks(scene_folder):
    scene = read_scene(scene_folder)
    for frame in (0, 2):
        points = np.load(scene_folder / "gt" / f"particles_{frame}.npy")
        for view in scene.views:
            mask = scene.frame(view, frame).mask > 0.5
            pixels, _ = scene.cameras[view].project(points.astype(float))
            column, row = np.floor(pixels).astype(int).T
            assert mask[row, column].mean() > 0.98
            # and they fill it: the silhouette is no larger than the ball
            covered = np.zeros_like(mask)
            covered[row, column] = True
            covered = cv2.dilate(covered.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            assert (mask & covered).sum() > 0.95 * mask.sum()


def test_free_fall_of_the_truth(scene_folder):
    """Before contact the centre follows v t + g t^2 / 2, and the ball keeps its spin."""
    points = [np.load(scene_folder / "gt" / f"particles_{frame}.npy").astype(float) for frame in range(3)]
    for frame, t in ((1, 1 / 24), (2, 2 / 24)):
        moved = points[frame].mean(0) - points[0].mean(0)
        np.testing.assert_allclose(moved, [0.5 * t, 0.2 * t - 4.9 * t * t, 0], atol=2.5e-3)
        a, b = points[0] - points[0].mean(0), points[frame] - points[frame].mean(0)
        turn = np.arctan2((a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum(), (a[:, [0, 2]] * b[:, [0, 2]]).sum())
        assert turn == pytest.approx(3.0 * t, rel=0.1)


def test_undeclared_drag_is_simulated_and_only_the_truth_tells(scene_folder, taichi, tmp_path):
    drag = {"linear_drag": {"rate": 4.0}}
    synthesise(SynthSpec.model_validate({**SMALL, "truth_particles": 4096, "effects": drag}), tmp_path / "scene")
    first, last = (np.load(tmp_path / "scene" / "gt" / f"particles_{k}.npy").astype(float) for k in (0, 2))
    assert (last - first).mean(0)[0] == pytest.approx(0.5 * (1 - np.exp(-4 / 12)) / 4, rel=0.02)  # 0.042 without drag
    assert yaml.safe_load((tmp_path / "scene" / "truth.yaml").read_text())["effects"] == drag
    assert yaml.safe_load((scene_folder / "truth.yaml").read_text())["effects"] == {}
    texts = [p for p in (tmp_path / "scene").rglob("*") if p.suffix in (".json", ".yaml") and p.name != "truth.yaml"]
    assert texts
    assert not any("drag" in p.read_text() for p in texts)


def test_ground_and_clock_of_a_spec_are_off(taichi):
    late = {**SMALL, "frames": 4, "effects": {"time_offset": {"delay": 0.011}}}
    spec = SynthSpec.model_validate(late)
    body = make_body(spec.shape, spec.particles)
    fall = simulate(spec, body).mean(1)[:, 1]
    t = np.arange(1, 4) / 24 + 0.011
    np.testing.assert_allclose(fall[1:] - fall[0], 0.2 * t - 4.9 * t * t, atol=3e-3)
    assert fall[0] == pytest.approx(body.particles[:, 1].mean(), abs=1e-6)
    raised = {**SMALL, "velocity": [0, -3.0, 0], "frames": 6, "effects": {"ground_height": {"height": 0.1}}}
    low, high = (simulate(SynthSpec.model_validate(s), body) for s in ({**raised, "effects": {}}, raised))
    assert high[:, :, 1].min() > low[:, :, 1].min() + 0.05


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"drag": {"rate": 1.0}}, "unknown effect 'drag'"),
        ({"linear_drag": {"strength": 1.0}}, r"effects\.linear_drag\.strength"),
        ({"linear_drag": {"rate": -1.0}}, "outside"),
        ({"linear_drag": {}}, "lacks rate"),
        ({"point_mass": {"mass": 1.0, "x": 0.0}}, "lacks y, z"),
        ({"time_offset": {"delay": -0.09}}, "before the start"),
    ],
)
def test_unusable_effect(taichi, given, message):
    spec = SynthSpec.model_validate({**SMALL, "effects": given})
    with pytest.raises(InputError, match=message):
        simulate(spec, make_body(spec.shape, spec.particles))


def test_same_seed_same_files_and_no_overwriting(scene_folder, tmp_path):
    again = tmp_path / "again"
    synthesise(SynthSpec.model_validate(SMALL), again)
    for path in scene_folder.rglob("*"):
        if path.is_file():
            assert (again / path.relative_to(scene_folder)).read_bytes() == path.read_bytes(), path.name
    with pytest.raises(InputError, match="new folder"):
        synthesise(SynthSpec.model_validate(SMALL), again)
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


@pytest.mark.parametrize(
    ("kind", "volume"),
    [("cube", 1.0), ("sphere", np.pi / 6), ("cylinder", np.pi * 0.4**2), ("cross", 0.36**3 + 6 * 0.32 * 0.36**2)],
)
def test_volume_of_shapes(kind, volume):
    body = make_body(ShapeSpec(kind=kind, size=0.5, clearance=0.2), 8000)
    assert body.volume == pytest.approx(volume * 0.125, rel=0.03)
    assert len(body.particles) == pytest.approx(8000, rel=0.15)
    assert body.vertices[:, 1].min() == pytest.approx(0.2)
    assert np.ptp(body.vertices, axis=0).max() == pytest.approx(0.5)
    # every particle is within the hull of the surface
    assert (body.particles.min(0) > body.vertices.min(0)).all()
    assert (body.particles.max(0) < body.vertices.max(0)).all()


def test_mesh_is_used_and_must_be_closed(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.export(tmp_path / "ball.obj")
    body = make_body(ShapeSpec(kind="mesh", mesh=tmp_path / "ball.obj", size=0.5), 3000)
    assert body.volume == pytest.approx(mesh.volume / 8 * 0.125, rel=0.08)
    mesh.update_faces(np.arange(len(mesh.faces)) > 3)
    mesh.export(tmp_path / "open.obj")
    with pytest.raises(InputError, match="watertight"):
        make_body(ShapeSpec(kind="mesh", mesh=tmp_path / "open.obj", size=0.5), 1000)


def test_spec_names_the_nearest_key_and_finds_its_mesh(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text("shape: {kind: cube, sise: 0.4}\n")
    with pytest.raises(InputError, match=r"shape\.size"):
        read_spec(path)
    path.write_text("shape: {kind: mesh, mesh: absent.obj}\n")
    with pytest.raises(InputError, match=r"absent\.obj"):
        read_spec(path)


def test_skin_follows_any_affine_motion_exactly():
    rng = np.random.default_rng(0)
    particles, vertices = rng.uniform(-1, 1, (500, 3)), rng.uniform(-1.05, 1.05, (80, 3))
    skin = Skin(vertices, particles)
    np.testing.assert_allclose(skin.at(particles), vertices, atol=1e-12)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    np.testing.assert_allclose(skin.at(particles @ turn.T + 2.0), vertices @ turn.T + 2.0, atol=0.02)


def test_rasteriser_against_ray_casting():
    """Two crossing triangles, seen at an angle: same face and point as Moeller and Trumbore find."""
    vertices = np.array(
        [[-0.6, 0, 0.1], [0.6, 0.1, -0.2], [0, 0.9, 0.3], [-0.5, 0.3, -0.5], [0.1, 0.8, 0.5], [0.6, 0.2, 0.4]]
    )
    faces = np.array([[0, 1, 2], [3, 4, 5], [2, 1, 0], [5, 4, 3]])
    camera = look_at("0", np.array([0.8, 0.9, 2.2]), np.array([0, 0.4, 0]), 60, 80.0)
    face, barycentric = rasterise(camera, vertices, faces)
    rays = pixel_rays(camera).reshape(-1, 3)
    best = np.full(len(rays), np.inf)
    for a, b, c in vertices[faces[:2]]:
        solution = np.linalg.solve(
            np.stack([np.broadcast_to(b - a, rays.shape), np.broadcast_to(c - a, rays.shape), -rays], axis=-1),
            np.broadcast_to((camera.centre - a)[None, :, None], (len(rays), 3, 1)),
        )[..., 0]
        u, v, t = solution.T
        best = np.minimum(best, np.where((u >= 0) & (v >= 0) & (u + v <= 1), t, np.inf))
    hit = (face >= 0).ravel()
    assert (hit == np.isfinite(best)).mean() > 0.999
    assert hit.sum() > 300
    points = np.einsum("pk,pki->pi", barycentric.reshape(-1, 3)[hit], vertices[faces[face.ravel()[hit]]])
    distance = np.linalg.norm(points - camera.centre, axis=1)
    both = np.isfinite(best[hit])
    np.testing.assert_allclose(distance[both], best[hit][both], atol=1e-6)
