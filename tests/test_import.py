"""Footage whose every number is known is imported and read back: cameras, times, pictures, masks, world."""

from __future__ import annotations

import json
import tracemalloc

import cv2
import footage_files as made
import numpy as np
import pytest
import tiny_scenes as tiny
import yaml

from masiv.errors import InputError
from masiv.footage.board import frame_of_board
from masiv.footage.calibration import camera_of, read_calibration
from masiv.footage.common_frames import MISSING, common_frames
from masiv.footage.empty_scene import Chroma
from masiv.footage.make_scene import make_scene
from masiv.footage.request import ImportRequest
from masiv.observations.read import read_scene

OFFSETS = {name: -start for name, start in zip(made.NAMES, made.STARTS, strict=True)}
"""Reading of each camera's clock at the common time 0, if it is 0 at its first picture."""
RATE = {"": made.FPS}
DISTORTION = {"k1": -0.25, "k2": 0.06, "p1": 0.002, "p2": -0.003}


def imported(tmp_path, out="scene", **request):
    summary = make_scene(ImportRequest(**request), tmp_path / out)
    return read_scene(tmp_path / out), summary


def assert_cameras_are_exact(scene, names=made.NAMES, factor=(1.0, 1.0)):
    assert tuple(camera.name for camera in scene.cameras) == names
    for view, camera in enumerate(scene.cameras):
        np.testing.assert_allclose(camera.world_to_camera, made.world_to_camera(view), atol=1e-12)
        for point in tiny.CENTRE + np.array([[0.1, 0.2, -0.1], [-0.2, 0.05, 0.1]]):
            by_hand = tiny.pixel(view, point) * factor
            np.testing.assert_allclose(camera.project(point[None])[0][0], by_hand, atol=1e-9)


def assert_dot_is_in_place(scene, summary, tolerance, *, by_colour=False):
    """In each picture the mask, or the dot's share of the red light, is where the camera projects the dot."""
    for view, camera in enumerate(scene.cameras):
        for frame in range(scene.frame_count):
            at = summary["first_frame_s"] + frame / scene.fps
            expected = camera.project(made.dot(at)[None])[0][0]
            picture = scene.frame(view, frame)
            found = tiny.centroid(picture.image[..., 0] - made.GREY if by_colour else picture.mask)
            np.testing.assert_allclose(found, expected, atol=tolerance, err_msg=f"view {view}, frame {frame}")


def psnr(one, other):
    return 10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2))


CALIBRATIONS = {
    "toml": lambda folder: made.toml(folder / "calibration.toml"),
    "transforms": lambda folder: made.transforms(folder / "transforms.json"),
    "COLMAP binary": lambda folder: made.colmap(folder / "sparse" / "0", binary=True).parents[1],
    "COLMAP text": lambda folder: made.colmap(folder / "colmap", binary=False, picture_name="{}/frame_0001.png"),
}


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_each_calibration_gives_the_same_cameras_and_exact_pictures(tmp_path, kind):
    footage = made.footage(tmp_path / "footage")
    scene, summary = imported(
        tmp_path,
        footage=footage,
        calibration=CALIBRATIONS[kind](tmp_path),
        recorded_fps=RATE,
        offsets=OFFSETS,
        scale=1.0,
        start=0.0,
        end=0.4,
    )
    assert_cameras_are_exact(scene)
    assert (scene.fps, scene.frame_count, summary["first_frame_s"]) == (made.FPS, 13, pytest.approx(0, abs=1e-12))
    for view, camera in enumerate(summary["cameras"]):
        assert camera["source_frames"] == [round(-made.STARTS[view] * made.FPS) + k for k in range(13)]
        assert camera["late_mean_ms"] == pytest.approx(0, abs=1e-6)
        for frame in range(13):
            truth = made.picture(tiny.pixel(view, made.dot(frame / made.FPS)))
            np.testing.assert_array_equal(scene.frame(view, frame).image, truth)
    assert_dot_is_in_place(scene, summary, tolerance=0.03, by_colour=True)


def test_videos_with_distortion_are_undistorted_by_the_reader(tmp_path):
    """The plate makes the masks; H.264 leaves errors of a few grey levels."""
    footage = made.footage(tmp_path / "footage", "video", distortion=DISTORTION)
    plates = tmp_path / "plates"
    made.write_pictures(plates / "left", [made.picture(None)] * 2)
    made.write_video(plates / "middle.mp4", [made.picture(None)] * 5)
    cv2.imwrite(str(plates / "right.png"), made.picture(None))
    scene, summary = imported(
        tmp_path,
        footage=footage,
        calibration=made.toml(tmp_path / "c.toml", distortion=DISTORTION),
        offsets=OFFSETS,
        plates=plates,
        start=0.0,
        end=0.4,
    )
    assert scene.mask_source == "difference from the view's picture before time 0"
    assert_dot_is_in_place(scene, summary, tolerance=0.3)
    rows = json.loads((tmp_path / "scene/transforms.json").read_text())["frames"]
    for view, name in enumerate(made.NAMES):
        mine = [row for row in rows if f"/{name}/" in row["file_path"] and row["time"] >= 0]
        for frame, row in enumerate(mine):
            truth = made.picture(tiny.pixel(view, made.dot(frame / made.FPS), tiny.K, DISTORTION))
            written = cv2.imread(str(tmp_path / "scene" / row["file_path"]))
            assert psnr(written[..., ::-1], truth) > 35


@pytest.mark.parametrize("model", made.BENT)
def test_a_lens_that_readers_do_not_know_is_undistorted_once(tmp_path, model):
    numbers, pixel = made.BENT[model]
    for view, name in enumerate(made.NAMES):
        pictures = (made.picture(pixel(view, made.dot(t))) for t in np.arange(6) / made.FPS)
        made.write_pictures(tmp_path / "footage" / name, pictures)
    calibration = made.colmap(tmp_path / "colmap", binary=True, model=model, more=numbers)
    scene, summary = imported(
        tmp_path, footage=tmp_path / "footage", calibration=calibration, recorded_fps=RATE, scale=1.0
    )
    assert json.loads((tmp_path / "scene/transforms.json").read_text())["frames"][0]["camera_model"] == "PINHOLE"
    assert_dot_is_in_place(scene, summary, tolerance=0.08, by_colour=True)
    bent = [pixel(view, made.dot(0)) - tiny.pixel(view, made.dot(0)) for view in range(3)]
    assert np.abs(bent).max() > 0.3  # what a pinhole camera would be off by


def test_downscaling_takes_the_intrinsics_along(tmp_path):
    masks = tmp_path / "masks"
    for view, name in enumerate(made.NAMES):
        alpha = (255 * tiny.cover(tiny.pixel(view, made.dot(t))) for t in made.own_times(view))
        made.write_pictures(masks / name, (np.repeat(np.round(a)[..., None], 3, -1).astype(np.uint8) for a in alpha))
    scene, summary = imported(
        tmp_path,
        footage=made.footage(tmp_path / "footage"),
        calibration=made.toml(tmp_path / "c.toml"),
        recorded_fps=RATE,
        offsets=OFFSETS,
        masks=masks,
        downscale=1.5,
        start=0.0,
        end=0.3,
        every=2,
        jpeg=95,
    )
    width, height = 64, 53
    factor = np.array([width / tiny.WIDTH, height / tiny.HEIGHT])
    assert_cameras_are_exact(scene, factor=factor)
    assert (scene.fps, scene.frame_count, scene.cameras[0].width) == (15, 5, width)
    assert scene.mask_source == "mask pictures (mask_path)"
    assert_dot_is_in_place(scene, summary, tolerance=0.05)
    truth = cv2.resize(made.picture(tiny.pixel(0, made.dot(0))), (width, height), interpolation=cv2.INTER_AREA)
    assert psnr(scene.frame(0, 0).image, truth) > 30
    assert (tmp_path / "scene/images/left/00000.jpg").is_file()


def lit(at, once):
    """Light of a flash that lasts ``once`` [s], with a lamp that flickers a little."""
    return lambda time: (60.0 if at <= time < at + once else 0.0) + 0.8 * np.sin(40 * time)


@pytest.mark.parametrize("lasts", [0.02, 10.0])
def test_a_flash_gives_the_common_time(tmp_path, lasts):
    """-0.1 s is a picture of each camera: found to the frame."""
    footage = made.footage(tmp_path / "footage", "video", light=lit(-0.1 - 1e-6, lasts))
    for view, name in enumerate(made.NAMES[:1]):  # the left one begins with the motion elsewhere: let it see the flash
        times = np.arange(-0.5, 0.8, 1 / made.FPS)
        made.write_video(footage / f"{name}.mp4", made.filmed(view, times, light=lit(-0.1 - 1e-6, lasts)))
    _, summary = imported(
        tmp_path, footage=footage, calibration=made.toml(tmp_path / "c.toml"), sync="flash", start=0.1, end=0.5
    )
    expected = [0.4, 0.2, 0.6]
    np.testing.assert_allclose([c["clock_zero_s"] for c in summary["cameras"]], expected, atol=1e-6)
    assert (summary["first_frame_s"], summary["frames"]) == (pytest.approx(0.1), 13)


def test_a_clap_gives_the_common_time(tmp_path):
    """The sound has noise, speech-like swells and the echo of the clap; AAC smears it by some milliseconds."""
    rng = np.random.default_rng(0)
    claps = {"left": 0.211, "middle": 0.4305, "right": 0.9}
    for view, (name, at) in enumerate(claps.items()):
        t = np.arange(round(1.6 * 48_000)) / 48_000
        sound = 0.01 * rng.normal(size=len(t)) + 0.2 * np.sin(2 * np.pi * 180 * t) * np.sin(np.pi * t / 1.6) ** 2
        after = t >= at
        sound[after] += 0.9 * rng.uniform(-1, 1, after.sum()) * np.exp(-(t[after] - at) / 0.02)
        made.write_video(tmp_path / "footage" / f"{name}.mp4", made.filmed(view, np.arange(48) / 30 - at), sound=sound)
    _, summary = imported(
        tmp_path, footage=tmp_path / "footage", calibration=made.toml(tmp_path / "c.toml"), sync="clap"
    )
    found = [camera["clock_zero_s"] for camera in summary["cameras"]]
    np.testing.assert_allclose(found, list(claps.values()), atol=4e-3)


@pytest.mark.parametrize("source", ["names", "lists"])
def test_time_stamps_put_the_frames_in_place(tmp_path, source):
    """Clocks with an epoch in nanoseconds; cameras of 30, 30 and 60 pictures a second; jitter; two dropped pictures."""
    rng, epoch, rates = np.random.default_rng(1), 1_700_000_000, (30.0, 30.0, 60.0)
    lists = tmp_path / "lists"
    lists.mkdir()
    for view, name in enumerate(made.NAMES):
        times = made.own_times(view, fps=rates[view])
        times = times + rng.uniform(-1e-3, 1e-3, len(times))
        dropped = {1: [12, 15], 0: [], 2: []}[view]
        times = np.delete(times, dropped)
        stamps = [round((epoch + t) * 1e9) for t in times]
        folder = made.write_pictures(tmp_path / "footage" / name, made.filmed(view, times))
        if source == "names":
            for path, stamp in zip(sorted(folder.iterdir()), stamps, strict=True):
                path.rename(folder / f"cam{view}_{stamp}.png")
        (lists / f"{name}.csv").write_text("time_ns,gain\n" + "".join(f"{s},1.0\n" for s in stamps))
    scene, summary = imported(
        tmp_path,
        footage=tmp_path / "footage",
        calibration=made.toml(tmp_path / "c.toml"),
        times="names" if source == "names" else str(lists),
        time_unit="ns",
        sync="clock",
        start=0.0,
        end=0.4,
    )
    # The left camera begins last, at the common time 0 of the motion, up to its jitter.
    assert scene.fps == pytest.approx(30, rel=2e-3)
    assert [c["pictures"] for c in summary["cameras"]] == [13, 11, 13]
    assert [k for k, index in enumerate(summary["cameras"][1]["source_frames"]) if index is None] == [3, 6]
    assert any("middle has no picture at frame 3, 6" in problem for problem in summary["problems"])
    speed = np.linalg.norm(made.dot(0.3) - made.dot(0.1)) / 0.2
    pixels_a_second = speed * tiny.FOCAL_X / 1.2
    for view in (0, 2):
        for frame in range(scene.frame_count):
            expected = scene.cameras[view].project(made.dot(frame / 30)[None])[0][0]
            found = tiny.centroid(scene.frame(view, frame).mask)
            assert np.abs(found - expected).max() < 0.5 + 4e-3 * pixels_a_second


def test_slow_motion_is_timed_by_its_true_rate(tmp_path):
    """A phone stores 240 pictures a second as a video of 30."""
    for view, name in enumerate(made.NAMES):
        made.write_video(tmp_path / "footage" / f"{name}.mp4", made.filmed(view, np.arange(40) / 240), fps=30)
    scene, _ = imported(
        tmp_path, footage=tmp_path / "footage", calibration=made.toml(tmp_path / "c.toml"), recorded_fps={"": 240.0}
    )
    assert (scene.fps, scene.frame_count) == (240, 40)


def test_chroma_and_plate_seconds_give_masks(tmp_path):
    green = (40, 190, 60)
    footage = made.footage(tmp_path / "footage", background=green)
    common = {"footage": footage, "calibration": made.toml(tmp_path / "c.toml"), "recorded_fps": RATE}
    common |= {"offsets": OFFSETS, "start": 0.0, "end": 0.2}
    scene, summary = imported(tmp_path, chroma=Chroma(90, 150), **common)
    assert_dot_is_in_place(scene, summary, tolerance=0.35)
    masks = [cv2.imread(str(p)) for p in sorted((tmp_path / "scene/masks/left").iterdir())]
    truth = [tiny.cover(tiny.pixel(0, made.dot(k / 30))) > 0.5 for k in range(len(masks))]
    overlap = [(m[..., 0] > 0)[t].mean() for m, t in zip(masks, truth, strict=True)]
    assert min(overlap) > 0.9
    assert max(np.mean(m > 0) / np.mean(t) for m, t in zip(masks, truth, strict=True)) < 1.8

    # An empty stretch before the object enters.
    for view, name in enumerate(made.NAMES):
        times = made.own_times(view)
        pictures = (made.picture(None if t < -0.1 else tiny.pixel(view, made.dot(t))) for t in times)
        folder = tmp_path / "entering" / name
        extra = [made.picture(None)] * 10  # the left one too begins before
        made.write_pictures(folder, [*extra, *pictures])
    common |= {"footage": tmp_path / "entering", "offsets": {k: v + 10 / 30 for k, v in OFFSETS.items()}}
    scene, summary = imported(tmp_path, out="entered", plate_seconds=(-0.35, -0.15), **common)
    assert scene.mask_source == "difference from the view's picture before time 0"
    assert_dot_is_in_place(scene, summary, tolerance=0.3)
    np.testing.assert_array_equal(scene.background(0), made.picture(None))


def test_scale_ground_and_up_by_landmarks_and_baseline(tmp_path):
    """The calibration is in inches; the ground is tilted; the landmarks are where the dot would be."""
    unit = 0.0254
    footage = made.footage(tmp_path / "footage")
    calibration = made.toml(tmp_path / "c.toml", unit=unit, distortion=DISTORTION)
    normal = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])
    height = 0.4
    base = normal * height
    side = np.cross(normal, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    places = {"a": base, "b": base + 0.2 * side, "c": base + 0.15 * np.cross(normal, side)}
    places["top"] = base + 0.3 * normal
    points = {
        name: {c: tiny.pixel(v, p, tiny.K, DISTORTION).tolist() for v, c in enumerate(made.NAMES)}
        for name, p in places.items()
    }
    said = {"points": points, "distances": [["a", "b", 0.2], ["a", "top", 0.3]], "ground": ["a", "b", "c"]}
    landmarks = tmp_path / "landmarks.yaml"
    landmarks.write_text(yaml.safe_dump(said))
    common = {"footage": footage, "calibration": calibration, "recorded_fps": RATE}
    scene, summary = imported(tmp_path, landmarks=landmarks, **common)
    assert summary["metres_per_unit"] == pytest.approx(unit, rel=1e-6)
    for view, camera in enumerate(scene.cameras):
        np.testing.assert_allclose(camera.centre, tiny.pose(view)[:3, 3], atol=1e-5)
    np.testing.assert_allclose(scene.ground.normal, normal, atol=1e-5)
    assert scene.ground.height == pytest.approx(height, abs=1e-5)
    np.testing.assert_allclose(scene.up, normal, atol=1e-5)

    length = float(np.linalg.norm(tiny.pose(0)[:3, 3] - tiny.pose(2)[:3, 3]))
    scene, summary = imported(
        tmp_path, out="line", baseline=("left", "right", length), up="y", ground=0.25, density=1070.0, **common
    )
    assert summary["metres_per_unit"] == pytest.approx(unit, rel=1e-9)
    np.testing.assert_allclose(scene.up, [0, 1, 0])
    assert (scene.ground.height, scene.density) == (0.25, 1070)

    said["points"]["a"]["left"] = [30.0, 12.0]
    landmarks.write_text(yaml.safe_dump(said))
    with pytest.raises(InputError, match=r"point 'a' is \d+\.\d px off in \w+ from where its cameras"):
        imported(tmp_path, out="wrong", landmarks=landmarks, **common)


def test_scale_and_ground_by_a_checkerboard(tmp_path):
    """A board of 7×5 inner corners of 40 mm, drawn by its homography in each view; one picture is turned half round."""
    columns, rows, square = 7, 5, 0.04
    origin = np.array([-0.1, 0.35, -0.25])
    across, along = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    (tmp_path / "board").mkdir()
    cell = 40
    flat = np.full(((rows + 3) * cell, (columns + 3) * cell), 255, np.uint8)
    for i in range(rows + 1):
        for j in range(columns + 1):
            if (i + j) % 2 == 0:
                flat[(i + 1) * cell : (i + 2) * cell, (j + 1) * cell : (j + 2) * cell] = 0
    cameras = []
    for view, name in enumerate(made.NAMES):
        camera = camera_of(read_calibration(made.toml(tmp_path / "c.toml", unit=0.5)), name, tmp_path)
        camera = camera.exactly_resized(10 * tiny.WIDTH, 10 * tiny.HEIGHT)
        cameras.append(camera)
        corners = []
        for x, y in ((0, 0), (columns + 3, 0), (columns + 3, rows + 3), (0, rows + 3)):
            point = origin + square * ((x - 2) * across + (y - 2) * along)
            corners.append(10 * tiny.pixel(view, point) - 0.5)
        source = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [flat.shape[1], flat.shape[0]] - 0.5
        transform = cv2.getPerspectiveTransform(source.astype(np.float32), np.array(corners, np.float32))
        size = (10 * tiny.WIDTH, 10 * tiny.HEIGHT)
        drawn = cv2.warpPerspective(flat, transform, size, flags=cv2.INTER_AREA, borderValue=200)
        assert cv2.imwrite(str(tmp_path / "board" / f"{name}.png"), drawn)
    found = frame_of_board(tmp_path / "board", (columns, rows, square), cameras)
    assert found.metres == pytest.approx(0.5, rel=3e-3)
    normal, height = found.ground
    assert normal @ [0, 1, 0] > np.cos(np.radians(0.5))
    assert height == pytest.approx(0.35, abs=3e-3)


def test_masks_by_a_segmenter_are_declared(tmp_path):
    pytest.importorskip("transformers")
    from tiny_segmenter import write_weights

    weights = write_weights(tmp_path / "weights")
    scene, _ = imported(
        tmp_path,
        footage=made.footage(tmp_path / "footage"),
        calibration=made.toml(tmp_path / "c.toml"),
        recorded_fps=RATE,
        segmenter=weights,
        boxes={name: (20.0, 10.0, 60.0, 70.0) for name in made.NAMES},
        downscale=2.0,
    )
    assert scene.mask_source == "SAM 2 (weights)"
    declared = yaml.safe_load((tmp_path / "scene/scene.yaml").read_text())["masks"]
    np.testing.assert_allclose(declared["boxes"]["left"], [10, 5, 30, 35], atol=1e-6)


def test_only_one_picture_is_held(tmp_path):
    """90 MB of pictures go through a tenth of that."""
    for name in made.NAMES[:2]:
        pictures = (np.full((240, 320, 3), 40 + k % 100, np.uint8) for k in range(200))
        made.write_video(tmp_path / "footage" / f"{name}.mp4", pictures)
    text = made.toml(tmp_path / "c.toml").read_text().replace("[ 96, 80,]", "[ 320, 240,]")
    (tmp_path / "c.toml").write_text(text)
    tracemalloc.start()
    summary = make_scene(ImportRequest(tmp_path / "footage", tmp_path / "c.toml"), tmp_path / "scene")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert summary["frames"] == 200
    assert peak < 9e6


def test_common_frames_of_cameras_out_of_phase():
    """Two cameras of 50/s, 8 ms apart, and one of 100/s: every picture is used, errors are even about the frames."""
    times = [np.arange(50) / 50, 0.008 + np.arange(50) / 50, 0.001 + np.arange(99) / 100]
    frames = common_frames(["a", "b", "c"], times)
    assert (frames.fps, frames.count) == (50, 50)
    np.testing.assert_allclose(np.abs(frames.late[:2]), 0.004, atol=1e-9)
    assert np.abs(frames.late[2]).max() <= 0.005 + 1e-9
    assert (frames.chosen != MISSING).all()
    assert (np.diff(frames.chosen[2]) == 2).all()
    third = common_frames(["a", "b", "c"], times, every=3, start=0.1, end=0.5)
    assert third.fps == pytest.approx(50 / 3)
    assert third.first == pytest.approx(0.104)
    assert third.count == 7
