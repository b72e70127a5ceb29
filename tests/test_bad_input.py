"""Every reader, given a file that is damaged or edited by hand: it reads the file, or says in one sentence why it
cannot. Cases that people met, with the sentences: benchmarks/bad_inputs.py."""

from __future__ import annotations

import copy
import json
import os
import pickle
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cloud_scene import surface, write_cloud
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from motion_capture_files import fall, write_motive, write_qtm, write_trc
from small_run import KEY, write_run, write_scene
from tiny_scenes import blender, nerfstudio, springgaus_real, springgaus_synthetic

from masiv.checkpoint import Checkpoint
from masiv.config import load_config
from masiv.continuum.trajectory import Trajectory
from masiv.errors import InputError, of_system
from masiv.files import write_bytes
from masiv.hull.first_frame import first_frame_problems
from masiv.materials.load import load_law
from masiv.mesh import read_mesh
from masiv.observations.identity import content_hash
from masiv.observations.kept_masks import KeptMasks
from masiv.observations.read import read_observation
from masiv.pipeline.stages import read_metrics
from masiv.report.history import curves
from masiv.report.measure import read_truth, require_same_body
from masiv.report.sections.material import read_material
from masiv.report.sections.refinement import read_refined
from masiv.runfolder import RunFolder, load_motion
from masiv.scene.scene import Scene
from masiv.splat.dynamic import DynamicGaussians
from masiv.strict import read_json, read_yaml
from masiv.synth.spec import read_spec
from masiv.twin import Twin

BALLS = Path(__file__).parent / "golden" / "balls"
MANY = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
HOSTILE = (
    *(float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e-300, 1e30, 0, -1, 1.5, 10**400),
    *(True, None, "", "1", "none", "../../x", "a" * 500, "\0", [], {}, [[]], [1, 2], [float("nan")] * 3, [0, 0, 0]),
    *({"value": 1}, {"a": {"b": [1]}}, [[[[[[[[[1]]]]]]]]]),
)


def ends_well(read: Callable[[], Any]) -> Any:
    """What ``read`` gives, or None if it says in one sentence that it cannot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is dropped and made again
        try:
            return read()
        except (InputError, OSError) as error:
            text = str(error if isinstance(error, InputError) else of_system(error))
            assert "\n" not in text
            assert 10 < len(text) < 1500
            return None


# ---- what is damaged -----------------------------------------------------------------------------------------------


@st.composite
def damages(draw):
    """A function of a file's bytes: cut short, with other bytes somewhere, with bytes more or less, or anything."""
    kind = draw(st.sampled_from(["cut", "overwrite", "insert", "remove", "other"]))
    place = draw(st.floats(0, 1, exclude_max=True))
    some = draw(st.binary(min_size=1, max_size=24))

    def damage(data: bytes) -> bytes:
        at = int(place * len(data))
        return {
            "cut": data[:at],
            "overwrite": data[:at] + some + data[at + len(some) :],
            "insert": data[:at] + some + data[at:],
            "remove": data[:at] + data[at + len(some) :],
            "other": some,
        }[kind]

    return damage


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The keys that lead to each value in nested mappings and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [at, *(place for key, child in items for place in places(child, (*at, key)))]


@st.composite
def edits(draw):
    """A function that changes one value in nested mappings and lists: to a hostile one, away, or to another key."""
    where, what = draw(st.integers(0, 10**6)), draw(st.sampled_from(["put", "put", "put", "remove", "add"]))
    hostile = draw(st.sampled_from(HOSTILE))

    def edit(document: Any) -> Any:
        document = copy.deepcopy(document)
        known = places(document)
        *above, last = known[1 + where % (len(known) - 1)]
        parent = document
        for key in above:
            parent = parent[key]
        if what == "remove":
            del parent[last]
        elif what == "add" and isinstance(parent, dict):
            parent["unknown"] = hostile
        else:
            parent[last] = hostile
        return document

    return edit


# ---- files of a run ------------------------------------------------------------------------------------------------

RUN_FILES: dict[str, Callable[[Path], Any]] = {
    "run.yaml": lambda run: RunFolder.open(run).record,
    "twin.yaml": lambda run: _numbers_of_twin(Twin.load(run)),
    "law.safetensors": lambda run: _numbers_of_twin(Twin.load(run)),
    "particles.safetensors": lambda run: Twin.load(run).positions,
    "gaussians.ply": lambda run: DynamicGaussians.load(run).canonical.means,
    "deformation.safetensors": lambda run: dict(DynamicGaussians.load(run).deformation.state_dict()),
    "calibration.json": lambda run: DynamicGaussians.load(run).calibration,
    "trajectory.npz": lambda run: Trajectory.load(run / "trajectory.npz").positions,
    "rollout.npz": lambda run: load_motion(run / "rollout.npz")[0],
    "material.json": read_material,
    "refine.json": lambda run: read_refined(run),
    "refine.npz": lambda run: read_refined(run),
    "metrics.json": lambda run: read_metrics(RunFolder.open(run)),
    "log.csv": lambda run: curves(run / "log.csv"),
    "masks/view_0_0000.npz": lambda run: KeptMasks(run / "masks", KEY).read("view_0_0000"),
    "checkpoints/identify.pt": lambda run: Checkpoint(run / "checkpoints/identify.pt").load(),
}
CHECKED = ("law.safetensors", "particles.safetensors", "deformation.safetensors", "trajectory.npz", "rollout.npz")
"""Files of numbers in which no damage goes unnoticed, since they hold check sums."""


def _numbers_of_twin(twin: Twin) -> Any:
    return [twin.law.description(), twin.volume, twin.density, twin.gravity, twin.positions]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    write_run(folder)
    (folder / "log.csv").write_text("".join(f"fit,{k},9,error {k}.5 mm\n" for k in range(9)))
    return folder


@pytest.mark.parametrize("name", RUN_FILES)
def test_the_run_made_by_hand_is_read(run, name):
    """What follows has something to damage."""
    assert RUN_FILES[name](run) is not None


@pytest.mark.parametrize("name", RUN_FILES)
@MANY
@given(damage=damages())
def test_a_damaged_file_of_a_run(run, name, damage):
    path = run / name
    data = path.read_bytes()
    before = RUN_FILES[name](run) if name in CHECKED else None
    try:
        path.write_bytes(damage(data))
        after = ends_well(lambda: RUN_FILES[name](run))
    finally:
        path.write_bytes(data)
    if name in CHECKED and after is not None:
        assert content_hash(after) == content_hash(before)
    assert not list(run.rglob("*.tmp*"))


@pytest.mark.parametrize("name", [name for name in RUN_FILES if name.endswith((".yaml", ".json"))])
@MANY
@given(edit=edits())
def test_a_file_of_a_run_edited_by_hand(run, name, edit):
    path = run / name
    data = path.read_bytes()
    document = edit(yaml.safe_load(data))
    try:
        path.write_text(yaml.safe_dump(document) if name.endswith(".yaml") else json.dumps(document))
        ends_well(lambda: RUN_FILES[name](run))
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize("name", RUN_FILES)
def test_a_pipe_in_place_of_a_file_of_a_run(run, name):
    """Nobody writes to it, so reading it would never end."""
    path = run / name
    data = path.read_bytes()
    path.unlink()
    os.mkfifo(path)
    try:
        ends_well(lambda: RUN_FILES[name](run))
    finally:
        path.unlink(missing_ok=True)
        path.write_bytes(data)


def test_a_damaged_checkpoint_is_dropped_with_a_word(tmp_path):
    checkpoint = Checkpoint(tmp_path / "identify.pt")
    checkpoint.save({"step": 3})
    other = Checkpoint(tmp_path / "trajectory.pt")
    shutil.copy(tmp_path / "identify.pt", tmp_path / "trajectory.pt")
    with pytest.warns(UserWarning, match=r"trajectory\.pt is of another stage"):
        assert other.load() is None
    write_bytes(tmp_path / "identify.pt", (tmp_path / "identify.pt").read_bytes()[:100])
    with pytest.warns(UserWarning, match=r"identify\.pt is damaged"):
        assert checkpoint.load() is None
    assert list(tmp_path.iterdir()) == []


# ---- scenes --------------------------------------------------------------------------------------------------------


def _clouds(folder: Path) -> Path:
    folder.mkdir()
    (folder / "scene.yaml").write_text("fps: 24\n")
    for frame in range(2):
        write_cloud(folder / f"cloud_{frame}.ply", *surface(60, frame))
    return folder


def _tracks(folder: Path) -> Path:
    return Path(shutil.copytree(BALLS, folder))


def _c3d(folder: Path) -> Path:
    import c3d

    writer = c3d.Writer(point_rate=100.0)
    writer.set_point_labels(["tip"])
    for k in range(20):
        writer.add_frames([(np.array([[0.0, 0.0, 1000 - k, 0.0, 0.0]]), np.zeros((0, 0)))])
    folder.mkdir()
    with (folder / "drop.c3d").open("wb") as file:
        writer.write(file)
    (folder / "scene.yaml").write_text(
        "layout: tracks\nunits: mm\nbodies: {ball: {mass: 1}}\nruns: [{file: drop.c3d}]\n"
    )
    return folder


def _motion_capture(folder: Path) -> Path:
    """The same fall in three formats."""
    folder.mkdir()
    times = np.arange(20) / 100
    write_trc(folder / "drop.trc", ["tip"], fall(times)[:, None], times)
    write_qtm(folder / "drop.tsv", ["tip"], fall(times)[:, None], times)
    write_motive(folder / "drop.csv", ["tip"], fall(times)[:, None], times)
    runs = ", ".join(f"{{file: {name}, name: {name}}}" for name in ("drop.trc", "drop.tsv", "drop.csv"))
    (folder / "scene.yaml").write_text(f"layout: tracks\nbodies: {{ball: {{mass: 1}}}}\nruns: [{runs}]\n")
    return folder


def _phystwin(folder: Path) -> Path:
    import cv2

    for frame in range(2):
        for name in (f"color/0/{frame}.png", f"mask/0/{frame}.png"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name), np.full((8, 8, 3), 90, np.uint8))
        (folder / "depth/0").mkdir(parents=True, exist_ok=True)
        np.save(folder / f"depth/0/{frame}.npy", np.full((8, 8), 900, np.uint16))
    intrinsics = [[[9.0, 0, 4], [0, 9.0, 4], [0, 0, 1]]]
    (folder / "metadata.json").write_text(json.dumps({"intrinsics": intrinsics, "fps": 30, "WH": [8, 8]}))
    (folder / "calibrate.pkl").write_bytes(pickle.dumps([np.eye(4)]))
    return folder


SCENES: dict[str, Callable[[Path], Path]] = {
    "PAC-NeRF": write_scene,
    "nerfstudio": nerfstudio,
    "Blender": blender,
    "Spring-Gaus synthetic": springgaus_synthetic,
    "Spring-Gaus real": springgaus_real,
    "PhysTwin": _phystwin,
    "point clouds": _clouds,
    "tracks": _tracks,
    "C3D": _c3d,
    "motion capture": _motion_capture,
}
FILES = [
    *(("PAC-NeRF", name) for name in ("all_data.json", "scene.yaml", "data/r_0_0.png")),
    *(("nerfstudio", name) for name in ("transforms.json", "masks/cam0/frame_00001.png")),
    *(("Blender", name) for name in ("transforms_train.json", "transforms_test.json")),
    *(("Spring-Gaus synthetic", name) for name in ("camera.json", "frame.json")),
    ("Spring-Gaus real", "dynamic/cameras_calib.json"),
    ("Spring-Gaus real", "dynamic/sequences/dog/0.json"),
    ("Spring-Gaus real", "static/colmap/dog/cameras.bin"),
    *(("PhysTwin", name) for name in ("metadata.json", "calibrate.pkl", "depth/0/1.npy", "color/0/0.png")),
    *(("point clouds", name) for name in ("scene.yaml", "cloud_0.ply")),
    *(("tracks", name) for name in ("scene.yaml", "drops.csv")),
    ("C3D", "drop.c3d"),
    *(("motion capture", f"drop.{ending}") for ending in ("trc", "tsv", "csv")),
]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Folders of small scenes by layout."""
    root = tmp_path_factory.mktemp("scenes")
    return {name: make(root / name.replace(" ", "_")) for name, make in SCENES.items()}


def read_all(folder: Path) -> Any:
    """The scene with what is read of it later: pictures, depth, clouds."""
    found = read_observation(folder)
    if isinstance(found, Scene):
        if found.load_cloud is None:
            for view in found.views:
                found.frame(view, 0)
            first_frame_problems(found)
        else:
            found.cloud(0)
    return found


@pytest.mark.parametrize("layout", SCENES)
def test_the_small_scenes_are_read(scenes, layout):
    """What follows has something to damage."""
    assert read_all(scenes[layout]) is not None


@pytest.mark.parametrize(("layout", "name"), FILES)
@MANY
@given(damage=damages())
def test_a_damaged_file_of_a_scene(scenes, layout, name, damage):
    path = scenes[layout] / name
    data = path.read_bytes()
    try:
        path.write_bytes(damage(data))
        ends_well(lambda: read_all(scenes[layout]))
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize(("layout", "name"), [row for row in FILES if row[1].endswith((".yaml", ".json"))])
@MANY
@given(edit=edits())
def test_a_file_of_a_scene_edited_by_hand(scenes, layout, name, edit):
    path = scenes[layout] / name
    data = path.read_bytes()
    document = edit(yaml.safe_load(data))
    try:
        path.write_text(yaml.safe_dump(document) if name.endswith(".yaml") else json.dumps(document))
        ends_well(lambda: read_all(scenes[layout]))
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize(("layout", "name"), FILES)
def test_a_pipe_in_place_of_a_file_of_a_scene(scenes, layout, name):
    path = scenes[layout] / name
    data = path.read_bytes()
    path.unlink()
    os.mkfifo(path)
    try:
        ends_well(lambda: read_all(scenes[layout]))
    finally:
        path.unlink()
        path.write_bytes(data)


# ---- other files ---------------------------------------------------------------------------------------------------


def _config(path: Path) -> Any:
    return load_config(path=path)


@pytest.mark.parametrize("read", [read_yaml, read_json, read_spec, read_mesh, load_law, _config])
@MANY
@given(data=st.binary(max_size=80) | st.text("[]{}&*!:-,'\"\\ \nab01.e+", max_size=60).map(str.encode))
def test_any_bytes(tmp_path, read, data):
    path = tmp_path / "file.obj"
    path.write_bytes(data)
    ends_well(lambda: read(path))


@MANY
@given(edit=edits())
def test_a_configuration_edited_by_hand(tmp_path, edit):
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(edit(load_config("quick").model_dump(mode="json"))))
    ends_well(lambda: load_config(path=tmp_path / "settings.yaml"))


@MANY
@given(edit=edits())
def test_a_specification_edited_by_hand(tmp_path, edit):
    spec = {"shape": {"kind": "cube", "size": 0.4}, "velocity": [0, 1, 0], "fps": 24, "effects": {"swirl": {"rate": 1}},
            "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 1e4}, "density": 1e3},
            "cameras": {"count": 4, "heights": [1, 2]}}  # fmt: skip
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(edit(spec)))
    ends_well(lambda: read_spec(tmp_path / "spec.yaml"))


@MANY
@given(damage=damages(), frame=st.integers(0, 2))
def test_a_damaged_truth(tmp_path, damage, frame):
    for k in range(3):
        np.save(tmp_path / f"particles_{k}.npy", np.random.default_rng(k).normal(size=(9, 3)))
    path = tmp_path / f"particles_{frame}.npy"
    path.write_bytes(damage(path.read_bytes()))
    ends_well(lambda: read_truth(tmp_path, 3))


def test_the_truth_of_another_scene_is_refused():
    body = np.random.default_rng(0).uniform(size=(50, 3))
    require_same_body(body + 0.3, body, Path("gt"))
    for other in (body + 2.0, 10 * body, 1e-3 * body + 0.5):
        with pytest.raises(InputError, match="is not of this scene"):
            require_same_body(other, body, Path("gt"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("seed: 1\nseed: 2\n", "'seed' is given twice"),
        ("simulator: {chunks: 1, chunks: 2}\n", "'chunks' is given twice"),
        (f"seed: {'9' * 5000}\n", "digits"),
        ("seed: 2024-99-99\n", "month"),
        (f"seed: {'[' * 4000}\n", "recursion"),
    ],
)
def test_what_yaml_does_not_allow(tmp_path, text, says):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(InputError, match=says):
        load_config(path=tmp_path / "settings.yaml")


def test_a_key_may_come_from_another_mapping_and_be_given_again(tmp_path):
    """YAML's merge key is no second key."""
    (tmp_path / "a.yaml").write_text("base: &base {x: 1, y: 2}\nown: {<<: *base, y: 3}\n")
    assert read_yaml(tmp_path / "a.yaml")["own"] == {"x": 1, "y": 3}
