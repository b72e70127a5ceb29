"""Epipolar tangency: silhouettes agree if the cameras are right, and the camera that is wrong is named."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from ring_scene import look_at, ring, spheres_scene
from scipy.spatial.transform import Rotation

from masiv.calibration.consistency import odd_camera, silhouette_consistency
from masiv.calibration.tangency import Outline, outline, tangency_errors
from masiv.scene.frame_cache import Frame

NOTHING = np.zeros((0, 2))


def bodies(frame):
    at = np.array([0.05 * frame, 0.5 - 0.03 * frame, 0.02 * frame])
    return [(at, 0.2), (at + np.array([0.15, 0.1, 0.05]), 0.12), (at + np.array([-0.1, 0.15, 0.1]), 0.1)]


def turned(camera, degrees):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees)).as_matrix()
    return dataclasses.replace(camera, world_to_camera=pose @ camera.world_to_camera)


def exact_outline(camera, points):
    return Outline(cv2.convexHull(camera.project(points)[0].astype(np.float32))[:, 0].astype(np.float64), NOTHING)


def test_planes_through_the_baseline_touch_both_silhouettes_exactly():
    """A polytope: its silhouette is the convex hull of its projected corners."""
    rng = np.random.default_rng(0)
    points = [0, 0.4, 0] + 0.15 * rng.normal(size=(30, 3))
    cameras = ring(5, size=400, focal=600.0)
    seen = [exact_outline(camera, points) for camera in cameras]
    errors = [tangency_errors(cameras[i], seen[i], cameras[j], seen[j]) for i in range(5) for j in range(5) if i != j]
    assert np.abs(errors).max() < 1e-3  # corners in float32
    wrong = turned(cameras[1], [0.2, 0, 0])
    assert np.abs(tangency_errors(cameras[0], seen[0], wrong, seen[1])).max() > 0.5


def test_the_sign_says_whose_silhouette_is_too_large():
    points = [0, 0.4, 0] + 0.1 * np.random.default_rng(1).normal(size=(30, 3))
    one, other = ring(5, size=400, focal=600.0)[:2]
    large = exact_outline(one, [0, 0.4, 0] + 1.1 * (points - [0, 0.4, 0]))
    assert (tangency_errors(one, large, other, exact_outline(other, points)) > 1).all()
    assert (tangency_errors(other, exact_outline(other, points), one, large) < -1).all()


def test_no_plane_touches_an_object_between_two_cameras():
    points = [0, 0.4, 0] + 0.1 * np.random.default_rng(2).normal(size=(30, 3))
    target = np.array([0, 0.4, 0])
    one = look_at("a", np.array([2.0, 0.4, 0.0]), target, 200, 300.0)
    other = look_at("b", np.array([-2.0, 0.4, 0.0]), target, 200, 300.0)
    assert np.isnan(tangency_errors(one, exact_outline(one, points), other, exact_outline(other, points))).all()


def test_an_outline_is_at_the_half_level_between_pixel_centres():
    x, y = np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5)
    mask = np.clip(12.0 + 0.5 - np.hypot(x - 27.3, y - 24.6), 0, 1).astype(np.float32)
    found = outline(Frame(np.zeros((50, 60, 3), np.uint8), mask, np.ones(mask.shape, bool)))
    assert found is not None
    # Without the interpolation the error would be up to half a pixel.
    np.testing.assert_allclose(np.hypot(*(found.hull - [27.3, 24.6]).T), 12.0, atol=0.1)
    assert len(found.cut) == 0


def test_exact_cameras_agree_and_the_one_that_is_off_is_named():
    cameras = ring(6, size=160, focal=250.0)
    exact = silhouette_consistency(spheres_scene(bodies, cameras=cameras))
    assert np.nanmax(exact.pixels) < 0.5
    assert exact.suspect is None
    wrong = (*cameras[:4], turned(cameras[4], [0.7, 0.7, 0]), *cameras[5:])
    true = spheres_scene(bodies, cameras=cameras)
    scene = dataclasses.replace(true, cameras=wrong)
    found = silhouette_consistency(scene)
    assert found.suspect == 4
    assert found.pixels[4] > 2
    assert np.delete(found.pixels, 4).max() < 0.6  # the error of one camera is not blamed on the others
    assert "view 4" in str(odd_camera(scene, found))
    without = silhouette_consistency(scene.restricted(holdout_cameras=(4,)))
    assert without.views == (0, 1, 2, 3, 5)
    assert without.suspect is None


def test_a_clock_that_is_late_is_seen_too():
    late = spheres_scene(bodies, cameras=ring(6, size=160, focal=250.0), frame_count=5)
    load = late.load
    scene = dataclasses.replace(late, frame_count=4, load=lambda view, frame: load(view, frame + (view == 2)))
    assert silhouette_consistency(scene).suspect == 2


def test_all_cameras_alike_wrong_name_none():
    rng = np.random.default_rng(3)
    cameras = ring(6, size=160, focal=250.0)
    scene = spheres_scene(bodies, cameras=cameras)
    rough = tuple(turned(camera, 0.3 * rng.normal(size=3)) for camera in cameras)
    found = silhouette_consistency(dataclasses.replace(scene, cameras=rough))
    assert found.suspect is None
    assert np.nanmedian(found.pixels) > 0.7


@pytest.mark.parametrize("by_border", [False, True])
def test_a_silhouette_that_is_cut_off_says_nothing_on_that_side(by_border):
    """View 1 sees the left half only. Without the rule its errors are tens of pixels."""
    whole = spheres_scene(bodies, cameras=ring(6, size=160, focal=250.0))
    middle = int(np.nonzero(whole.frame(1, 0).mask.any(axis=0))[0].mean())

    def load(view, frame):
        seen = whole.load(view, frame)
        if view != 1:
            return seen
        if by_border:
            return Frame(seen.image[:, :middle], seen.mask[:, :middle], seen.valid[:, :middle])
        left = np.broadcast_to(np.arange(160) < middle, seen.mask.shape)
        return Frame(seen.image, np.where(left, seen.mask, 0), left)

    cameras = list(whole.cameras)
    if by_border:
        cameras[1] = dataclasses.replace(cameras[1], width=middle)
    found = silhouette_consistency(dataclasses.replace(whole, cameras=tuple(cameras), load=load))
    assert found.suspect is None
    assert np.nanmax(found.pixels) < 0.5
    assert np.isfinite(found.pixels[1])


def test_two_cameras_have_a_number_and_no_suspect():
    cameras = ring(6, size=160, focal=250.0)[:2]
    scene = spheres_scene(bodies, cameras=cameras)
    found = silhouette_consistency(dataclasses.replace(scene, cameras=(cameras[0], turned(cameras[1], [2, 0, 0]))))
    assert found.suspect is None
    assert found.pixels[0] == found.pixels[1] > 1


def test_inspect_shows_the_number_of_each_camera(tmp_path):
    from masiv.report.inspection import inspection

    cameras = ring(4, size=160, focal=250.0)
    wrong = (*cameras[:2], turned(cameras[2], [4, 0, 0]), cameras[3])
    scene = dataclasses.replace(spheres_scene(bodies, cameras=cameras), cameras=wrong)
    summary, text = inspection(scene, tmp_path / "sheet.png")
    assert summary["cameras"][2]["consistency_px"] > 5
    assert any(problem.startswith("view 2 (2): its silhouettes disagree") for problem in summary["problems"])
    assert f"2: {summary['cameras'][2]['consistency_px']:.2f}" in text
    json.dumps(summary, allow_nan=False)
