"""Recordings with a known fault: clocks, masks that flicker, gravity that is not that of the fall, what is drawn."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from ring_scene import look_at, ring, spheres_scene
from scipy.spatial.transform import Rotation
from test_consistency import bodies, turned

from masiv.calibration.clocks import clocks, late_cameras
from masiv.calibration.consistency import silhouette_consistency, tangency_series
from masiv.calibration.mask_flicker import flicker, flickering_masks, hole_share
from masiv.calibration.tangency import outline
from masiv.identifiability.fall import fall_problem, wrong_scale
from masiv.report.world_marks import ARROW, clipped, draw_world, round_length
from masiv.scene.scene import Ground

FRAMES, FPS = 8, 24.0
CAMERAS = ring(5, size=160, focal=250.0)
UP = np.array([0.0, 1.0, 0.0])
G = np.array([0.0, -9.8, 0.0])


def falling(frame):
    """Spheres that tumble and fall, at any time [frames]."""
    parts = bodies(0)
    middle = np.mean([at for at, _ in parts], axis=0)
    turn = Rotation.from_rotvec([0.1 * frame, 0.15 * frame, 0])
    way = np.array([0.03 * frame, 0.02 * frame - 0.5 * 9.8 * (frame / FPS) ** 2 * 0.5, 0.02 * frame])
    return [(middle + turn.apply(at - middle) + way, radius) for at, radius in parts]


def recording(offset=0.0, view=2, cameras=CAMERAS, spoil=None):
    """View ``view`` shows a time that is later by ``offset`` frames."""
    on_time = spheres_scene(falling, frame_count=FRAMES, cameras=cameras, spoil=spoil)
    shifted = spheres_scene(lambda frame: falling(frame + offset), frame_count=FRAMES, cameras=cameras, spoil=spoil)
    return dataclasses.replace(on_time, load=lambda v, f: (shifted if v == view else on_time).load(v, f))


def outlines_of(scene):
    return [[outline(scene.frame(view, frame)) for frame in range(scene.frame_count)] for view in scene.views]


def clocks_of(scene):
    return clocks(scene.views, [scene.cameras[view] for view in scene.views], outlines_of(scene), scene.fps)


@pytest.mark.parametrize("offset", [0.5, 2.0, -1.3])
def test_a_camera_with_a_late_clock_is_measured_and_named(offset):
    scene = recording(offset)
    found = clocks_of(scene)
    said = late_cameras(scene, found, silhouette_consistency(scene))
    assert list(said) == [2]
    assert ("later" if offset > 0 else "earlier") in said[2]
    assert found.offsets[2] * FPS == pytest.approx(offset, abs=0.1)
    assert np.abs(np.delete(found.offsets, 2)).max() * FPS < 0.1
    assert found.standard_errors.max() * FPS < 0.05


def test_exact_clocks_are_not_blamed_nor_is_a_camera_that_is_turned():
    scene = recording()
    found = clocks_of(scene)
    assert late_cameras(scene, found, silhouette_consistency(scene)) == {}
    assert np.abs(found.z).max() < 5
    wrong = (*CAMERAS[:3], turned(CAMERAS[3], [1.2, 1.6, 0]), CAMERAS[4])
    scene = dataclasses.replace(scene, cameras=wrong)
    assert late_cameras(scene, clocks_of(scene), silhouette_consistency(scene)) == {}


@pytest.mark.parametrize("seen", [0, 1])
def test_masks_without_an_outline_say_nothing_about_clocks(seen):
    """Masks that are empty or cover the picture, of all cameras, or of all but one."""
    rows = outlines_of(recording())
    without = [row if view < seen else [None] * FRAMES for view, row in enumerate(rows)]
    assert clocks(tuple(range(len(CAMERAS))), CAMERAS, without, FPS) is None


def test_a_recording_that_is_too_short_says_nothing_about_clocks():
    assert clocks_of(dataclasses.replace(recording(), frame_count=3)) is None


def spoilt(change):
    def spoil(view, frame, mask):
        valid = np.ones(mask.shape, bool)
        return (change(mask.copy()), valid) if (view, frame) == (1, 4) else (mask, valid)

    return spoil


def cut(mask):
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: rows[len(rows) // 4]] = 0
    return mask


def holed(mask):
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    return cv2.circle(mask, (int(column), int(row)), round(float(np.sqrt(0.06 * mask.sum() / np.pi))), 0.0, cv2.FILLED)


def flicker_of(scene):
    cameras = [scene.cameras[view] for view in scene.views]
    holes = np.full((len(cameras), scene.frame_count), np.nan)
    for row, view in enumerate(scene.views):
        for frame in range(1, scene.frame_count - 1):
            holes[row, frame] = hole_share(*(scene.frame(view, f).mask for f in (frame - 1, frame, frame + 1)))
    return flicker(scene.views, tangency_series(cameras, outlines_of(scene)), holes)


@pytest.mark.parametrize("change", [cut, holed, lambda mask: cv2.dilate(mask, np.ones((7, 7)))])
def test_a_mask_that_is_wrong_in_one_frame_is_named(change):
    scene = recording(spoil=spoilt(change))
    found = flicker_of(scene)
    assert found.frames == ((), (4,), (), (), ())
    (said,) = flickering_masks(scene, found, ())
    assert said.startswith("view 1 (1): its mask flickers at frame 4 (")
    assert flickering_masks(scene, found, {1}) == []


def test_good_masks_do_not_flicker():
    assert flicker_of(recording()).frames == ((),) * 5


def test_the_hole_of_a_ring_is_no_fault():
    disc = cv2.circle(np.zeros((80, 80), np.float32), (40, 40), 30, 1.0, cv2.FILLED)
    rings = [cv2.circle(disc.copy(), (40 + x, 40), 10, 0.0, cv2.FILLED) for x in (-4, 0, 4)]
    assert hole_share(*rings) == 0
    assert hole_share(disc, rings[1], disc) == pytest.approx(100 / (900 - 100), rel=0.1)
    assert np.isnan(hole_share(disc, 0 * disc, disc))


def thrown(count=10, noise=1e-3, gravity=G):
    t = np.arange(count) / FPS
    random = np.random.default_rng(4)
    return t, [0.5, 1.0, 0.2] * t[:, None] + 0.5 * gravity * t[:, None] ** 2 + noise * random.normal(size=(count, 3))


def test_a_fall_that_is_not_along_gravity_names_the_axis():
    t, path = thrown()
    assert fall_problem(t, path, 1e-3, G) is None
    said = fall_problem(t, path, 1e-3, np.array([0, 0, -9.8]))
    assert "correct up_axis" in said
    assert "-9.8" in said
    assert "correct up_axis" in fall_problem(t, path, 1e-3, -G)


def test_bodies_that_do_not_fly_say_nothing_about_gravity():
    t = np.arange(10) / FPS
    still = 1e-3 * np.random.default_rng(0).normal(size=(10, 3))
    bounces = np.abs(2.0 * (t - 0.15))[:, None] * UP + 0.5 * G * ((t - 0.15) ** 2)[:, None]
    for path in (still, bounces):
        for gravity in (G, np.array([0, 0, -9.8]), np.zeros(3)):
            assert fall_problem(t, path, 1e-3, gravity) is None


def test_a_wrong_frame_rate_shows_in_the_fall():
    t, path = thrown()
    assert wrong_scale(t, path, 1e-3, G) is None
    assert "a factor of 0.5 would" in wrong_scale(t / 2, path, 1e-3, G).replace("0.502", "0.5").replace("0.498", "0.5")
    assert "check fps" in wrong_scale(t, 1e-3 * path, 1e-6, G)
    assert wrong_scale(t, thrown(gravity=1.2 * G)[1], 1e-3, G) is None  # a body that is heavier than it seems, a wind


def test_lengths_are_round():
    assert [round_length(x) for x in (0.3, 0.1, 0.99, 7.0, 0.02)] == [0.2, 0.1, 0.5, 5.0, 0.02]


def test_the_arrow_is_where_the_camera_sees_it():
    camera = look_at("a", np.array([2.0, 1.0, 0.5]), np.array([0, 0.3, 0]), 200, 300.0)
    picture, mask = np.zeros((400, 400, 3), np.uint8), np.zeros((400, 400), np.float32)
    mask[:, :150] = 1
    drawn = draw_world(picture, camera, UP, Ground(UP, 0.1), np.array([0.1, 0.6, 0.0]), 0.2, mask)
    assert (drawn[:, :150] == 0).all()  # the object hides the grid
    assert (drawn[:, 250:] != 0).any()
    ends = 2 * camera.project(np.array([[0.1, 0.1, 0.0], [0.1, 0.3, 0.0]]))[0]  # the picture is twice as large
    middle = np.round(ends.mean(axis=0) - 0.5).astype(int)
    assert tuple(drawn[middle[1], middle[0]]) == ARROW
    rows = np.flatnonzero((drawn == ARROW).all(axis=2).any(axis=1))
    assert abs(rows.min() + 0.5 - ends[1, 1]) < 3
    assert abs(rows.max() + 0.5 - ends[0, 1]) < 3


def test_lines_end_before_the_camera():
    camera = look_at("a", np.array([0, 0, 2.0]), np.zeros(3), 100, 100.0)
    line = np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 5.0]])  # from the middle to behind the camera
    ends = clipped(camera, line, 0.5)
    np.testing.assert_allclose(ends, camera.project(np.array([[0.1, 0, 0], [0.1, 0, 1.5]]))[0], atol=1e-9)
    assert clipped(camera, line + np.array([0, 0, 4.0]), 0.5) is None


def test_inspect_says_all_of_it(tmp_path):
    from masiv.report.inspection import inspection

    scene = recording(2.0, spoil=spoilt(cut))
    summary, text = inspection(scene, tmp_path / "sheet.png")
    json.dumps(summary, allow_nan=False)
    camera = summary["cameras"][2]
    assert camera["time_offset_ms"] == pytest.approx(2e3 / FPS, abs=3)
    assert 0 < camera["time_offset_error_ms"] < 5
    assert summary["cameras"][1]["flickering_frames"] == [4]
    assert sum("later than those" in problem for problem in summary["problems"]) == 1
    assert sum("flickers" in problem for problem in summary["problems"]) == 1
    assert not any("silhouettes disagree" in problem for problem in summary["problems"])
    assert set(summary["identifiability"][0]) == {
        "recording", "stiffness", "viscosity", "drag", "friction", "restitution"
    }  # fmt: skip
    assert "  stiffness: " in text
    sheet = cv2.cvtColor(cv2.imread(str(tmp_path / "sheet.png")), cv2.COLOR_BGR2RGB)
    assert (sheet == ARROW).all(axis=2).any()
