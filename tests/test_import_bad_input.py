"""What ``masiv import`` cannot use ends with one sentence and exit code 2, and leaves nothing behind."""

from __future__ import annotations

import json
import shutil
import sys

import cv2
import footage_files as made
import numpy as np
import pytest
import tiny_scenes as tiny

from masiv.cli import main

FPS = "--recorded-fps=30"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Short footage as pictures and as videos, and calibrations."""
    root = tmp_path_factory.mktemp("inputs")
    for view, name in enumerate(made.NAMES):
        pictures = [made.picture(tiny.pixel(view, made.dot(k / 30))) for k in range(6)]
        made.write_pictures(root / "pictures" / name, pictures)
        made.write_video(root / "videos" / f"{name}.mp4", pictures)
        if view:
            shutil.copytree(root / "pictures" / name, root / "uneven" / name)
        else:
            made.write_pictures(root / "uneven" / name, [p[:40] for p in pictures])
    made.toml(root / "c.toml")
    made.colmap(root / "colmap", binary=True)
    made.colmap(root / "fov", binary=False, model="FOV", more=(0.9,))
    return root


def _write(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data) if isinstance(data, bytes) else path.write_text(data)
    return path


def _broken_video(root, tmp, data):
    shutil.copytree(root / "videos", tmp / "footage")
    _write(tmp / "footage" / "left.mp4", data)
    return tmp / "footage"


def _lists(tmp, times):
    for name in made.NAMES:
        _write(tmp / "lists" / f"{name}.txt", "".join(f"{t}\n" for t in times))
    return tmp / "lists"


def _landmarks(tmp, text):
    return ["--landmarks", _write(tmp / "l.yaml", text)]


def _plates(tmp, size):
    for name in made.NAMES[: 3 if size else 2]:
        (tmp / "plates").mkdir(exist_ok=True)
        shape = size or (tiny.HEIGHT, tiny.WIDTH)
        cv2.imwrite(str(tmp / "plates" / f"{name}.png"), np.full((*shape, 3), 90, np.uint8))
    return tmp / "plates"


def _masks(root, tmp):
    shutil.copytree(root / "pictures", tmp / "masks")
    (tmp / "masks" / "left" / "0003.png").unlink()
    return tmp / "masks"


def _two_poses(tmp):
    listing = json.loads(made.transforms(tmp / "t" / "transforms.json").read_text())
    listing["frames"][0]["file_path"] = "images/left/1.jpg"
    listing["frames"][1]["file_path"] = "images/left/2.jpg"
    return _write(tmp / "t" / "transforms.json", json.dumps(listing))


def _bad_toml(tmp, old, new):
    path = made.toml(tmp / "bad.toml")
    assert old in path.read_text()
    return _write(path, path.read_text().replace(old, new, 1))


def _no_numbers(root, tmp):
    shutil.copytree(root / "pictures", tmp / "named")
    for folder in (tmp / "named").iterdir():
        for k, path in enumerate(sorted(folder.iterdir())):
            path.rename(folder / f"{'abcdef'[k]}.png")
    return tmp / "named"


def _cut(root, tmp):
    shutil.copytree(root / "colmap", tmp / "cut")
    return _write(tmp / "cut" / "images.bin", (root / "colmap" / "images.bin").read_bytes()[:100]).parent


SMALL = "points: {a: {left: [30, 30], right: [30, 30]}}\n"

# name: (arguments after the footage and before --out, part of the sentence); r: inputs, t: folder of the test
CASES = {
    "no footage": (lambda r, t: [t / "none", "--calibration", r / "c.toml"], "is not a folder"),
    "empty folder": (lambda r, t: [t, "--calibration", r / "c.toml"], "has no video and no folder of pictures"),
    "one camera": (
        lambda r, t: [r / "pictures", "--calibration", r / "c.toml", "--camera", "left=left"],
        "two cameras",
    ),
    "empty video": (lambda r, t: [_broken_video(r, t, b""), "--calibration", r / "c.toml"], "no picture that can be"),
    "no video": (lambda r, t: [_broken_video(r, t, b"abc" * 999), "--calibration", r / "c.toml"], "can be decoded"),
    "no calibration": (lambda r, t: [r / "videos", "--calibration", t / "c.toml"], "c.toml is missing"),
    "unknown calibration": (lambda r, t: [r / "videos", "--calibration", t / "c.xml"], "give a COLMAP folder"),
    "empty calibration": (lambda r, t: [r / "videos", "--calibration", t], "neither COLMAP's cameras and images"),
    "no TOML": (lambda r, t: [r / "videos", "--calibration", _write(t / "c.toml", "[[")], "is not valid TOML"),
    "no camera": (lambda r, t: [r / "videos", "--calibration", _write(t / "c.toml", "a = 1")], "has no camera"),
    "NaN": (lambda r, t: [r / "videos", "--calibration", _bad_toml(t, "[[120.0", "[[nan")], "3×3 finite numbers"),
    "bad distortions": (
        lambda r, t: [r / "videos", "--calibration", _bad_toml(t, "distortions = [0.0", "distortions = ['a'")],
        "'distortions' is no matrix of numbers",
    ),
    "camera missing": (
        lambda r, t: [r / "videos", "--calibration", _bad_toml(t, '"left"', '"links"')],
        "has no camera 'left' (it has links, middle, right)",
    ),
    "other shape": (
        lambda r, t: [r / "videos", "--calibration", _bad_toml(t, "[ 96, 80,]", "[ 96, 54,]")],
        "the pictures of left have 96×80 pixels, its calibration is for 96×54",
    ),
    "focal length": (lambda r, t: [r / "videos", "--calibration", _bad_toml(t, "[[120.0", "[[0.1")], "focal length"),
    "two poses": (lambda r, t: [r / "videos", "--calibration", _two_poses(t)], "2 pictures of 'left' with different"),
    "no scale": (lambda r, t: [r / "videos", "--calibration", r / "colmap"], "COLMAP's unit of length is arbitrary"),
    "COLMAP cut": (lambda r, t: [r / "videos", "--calibration", _cut(r, t), "--scale=1"], "images.bin is cut short"),
    "COLMAP model": (lambda r, t: [r / "videos", "--calibration", r / "fov", "--scale=1"], "camera model FOV is not"),
    "millimetres": (
        lambda r, t: [r / "videos", "--calibration", made.toml(t / "mm.toml", unit=1e-3)],
        "m apart: if the calibration is in millimetres, give --scale 0.001",
    ),
    "no rate": (lambda r, t: [r / "pictures", "--calibration", r / "c.toml"], "give --recorded-fps"),
    "uneven pictures": (lambda r, t: [r / "uneven", "--calibration", r / "c.toml", FPS], "another shape"),
    "no overlap": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--offset=left=-9"],
        "begins 8.833 s after middle ends: the recordings have no time in common",
    ),
    "start": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--start=7"], "--start 7 is not in what all"),
    "NaN start": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--start=nan"], "--start nan is not in"),
    "end": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--start=.1", "--end=.05"], "is not before"),
    "few frames": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--every=9"], "fewer than two frames"),
    "every": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--every=0"], "--every 0: give 1 or more"),
    "fps": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--fps=60"], "took 30 pictures a second"),
    "NaN fps": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--fps=nan"], "--fps: frame rate nan"),
    "list too short": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--times", _lists(t, [0, 1, 2])],
        "has 6 frames, but 3 times",
    ),
    "times not ascending": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--times", _lists(t, [0, 1, 3, 2, 4, 5])],
        "frame 3 is at 2 s, the one before it at 3 s",
    ),
    "no time": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--times", _lists(t, [0, 1, "x", 2, 4, 5])],
        "line 3: 'x' is no time",
    ),
    "no list": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--times", t], "left.txt is missing there"),
    "no numbers": (
        lambda r, t: [_no_numbers(r, t), "--calibration", r / "c.toml", "--times=names"],
        "there is no number in the name",
    ),
    "time unit": (
        lambda r, t: [r / "pictures", "--calibration", r / "c.toml", "--times=names", "--time-unit=h"],
        "--time-unit h: give one of",
    ),
    "names of a video": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--times=names"],
        "its frames have no names",
    ),
    "sync": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--sync=bang"], "--sync bang: give one of"),
    "no flash": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--sync=flash"], "no flash is found in"),
    "no sound": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--sync=clap"], "left.mp4 has no sound"),
    "clap of pictures": (
        lambda r, t: [r / "pictures", "--calibration", r / "c.toml", "--sync=clap", "--times=names"],
        "a folder of pictures, which has no sound",
    ),
    "offset of nobody": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--offset=top=1"],
        "--offset names 'top', the recordings are left, middle, right",
    ),
    "offset": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--offset=left"], "give --offset NAME=VALUE"),
    "offset NaN": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--offset=left=nan"], "a finite number"),
    "camera": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--camera=left=a.mp4", "--camera=right=b.mp4"],
        "a.mp4 is missing",
    ),
    "no plate": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--plates", _plates(t, None)],
        "has no right: give a picture or a clip of the empty scene",
    ),
    "small plate": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--plates", _plates(t, (40, 48))],
        "has 48×40 pixels, the footage has 96×80",
    ),
    "plate seconds": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--plate-seconds=5,6"],
        "left has no frame then",
    ),
    "masks": (
        lambda r, t: [r / "pictures", "--calibration", r / "c.toml", FPS, "--masks", _masks(r, t)],
        "has 5 masks of 96×80 pixels, the recording has 6 frames",
    ),
    "two masks": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--chroma=90-150", "--plates", t],
        "--plates and --chroma both say the masks",
    ),
    "chroma": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--chroma=green"], "give two hues"),
    "chroma of another screen": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--chroma=90-150"],
        "leaves 100% of the first picture of left",
    ),
    "box": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--box=left=1,2,3,4"],
        "--box is for --segmenter",
    ),
    "segmenter": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--segmenter", t],
        "is not installed" if not __import__("importlib.util").util.find_spec("transformers") else "no config.json",
    ),
    "two scales": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--scale=1", "--baseline=left,right=1"],
        "--scale and --baseline both say the unit of length",
    ),
    "scale": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--scale=-1"], "are positive"),
    "baseline": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--baseline=left,top=1"],
        "there is no camera 'top'",
    ),
    "landmark": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", *_landmarks(t, SMALL + "distances: [[a, b, 1]]")],
        "'b' is not among the points",
    ),
    "landmark off": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", *_landmarks(t, SMALL)],
        "px off in left from where its cameras together place it",
    ),
    "landmark in one view": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", *_landmarks(t, "points: {a: {left: [3, 3]}}")],
        "must be seen in two cameras",
    ),
    "landmark key": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", *_landmarks(t, SMALL + "distance: []")],
        "unknown key 'distance'",
    ),
    "ground": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--ground=0"], "give --up as well"),
    "up": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--up=w"], "--up w: give x, y, z"),
    "no up": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--up=0,0,0"], "--up is zero"),
    "board size": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--board", t, "--board-size=9x9x1"],
        "--board-size 9x9x1",
    ),
    "board": (
        lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--board", t, "--board-size=9x6x.02"],
        "is found in 0 pictures, two are needed",
    ),
    "downscale": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--downscale=.5"], "give 1 or more"),
    "jpeg": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--jpeg=0"], "--jpeg 0: give a quality"),
    "density": (lambda r, t: [r / "videos", "--calibration", r / "c.toml", "--density=1e300"], "--density: density"),
}


@pytest.mark.parametrize("case", CASES)
def test_one_sentence_and_nothing_left(tmp_path, inputs, monkeypatch, capfd, case):
    make, part = CASES[case]
    arguments = make(inputs, tmp_path)
    out = tmp_path / "scenes" / "new"
    monkeypatch.setattr(sys, "argv", ["masiv", "import", *map(str, arguments), "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        main.run()
    said = capfd.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert (ended.value.code, len(errors)) == (2, 1), said
    assert part in errors[0]
    assert "Traceback" not in said
    assert not list((tmp_path / "scenes").glob("*") if (tmp_path / "scenes").exists() else [])


def test_a_folder_that_holds_something_is_not_touched(tmp_path, inputs, monkeypatch, capfd):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "notes.txt").write_text("mine")
    arguments = [inputs / "videos", "--calibration", inputs / "c.toml", "--out", tmp_path / "scene"]
    monkeypatch.setattr(sys, "argv", ["masiv", "import", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main.run()
    assert ended.value.code == 2
    assert "holds something already" in capfd.readouterr().err
    assert [path.name for path in (tmp_path / "scene").iterdir()] == ["notes.txt"]


def test_the_command_prints_one_object_with_json(tmp_path, inputs, monkeypatch, capfd):
    arguments = [inputs / "videos", "--calibration", inputs / "colmap", "--baseline=left.png,right=1.5", "--up=y"]
    arguments += ["--camera=left.png=left.mp4", "--camera=right=right.mp4", "--out", tmp_path / "scene", "--json"]
    monkeypatch.setattr(sys, "argv", ["masiv", "import", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main.run()
    assert ended.value.code == 0
    said = json.loads(capfd.readouterr().out)
    assert said == {**json.loads((tmp_path / "scene" / "import.json").read_text()), "scene": str(tmp_path / "scene")}
    assert [camera["name"] for camera in said["cameras"]] == ["left.png", "right"]
