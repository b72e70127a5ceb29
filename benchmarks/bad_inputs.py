"""What each command says to an input that cannot be used: exit code, sentence, files left.

usage: python benchmarks/bad_inputs.py [--work FOLDER] [--only TEXT] [--out TABLE.md]

A scene of four cameras, its run and a run of tracks are made once in --work (a minute). Each case copies what it
needs, breaks one thing, and runs the command in a process of its own with a limit on time. Cases of a full or a
read-only disk mount a small tmpfs, which takes a privileged user; for others they are left out.

A case passes if the command ends in time with the exit code that is expected, one line `error: …` (or, where the
command can go on, a line that says what was dropped), no traceback and no temporary file. Ends with exit code 1 if one
does not pass.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

TIME_LIMIT_S = 90.0
"""Of a command: the longest takes 40 s, where a stage is done again."""
MEMORY_LIMIT_MB = 2000
"""Of the resident memory: an ordinary command on this scene has half of that."""
SPEC = {
    "shape": {"kind": "cube", "size": 0.4, "rotation_deg": [20, 30, 0], "clearance": 0.25},
    "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 4e4, "poissons_ratio": 0.3}},
    "velocity": [0.5, -1.5, 0.0],
    "frames": 4,
    "cameras": {"count": 4, "size": 48, "field_of_view_deg": 28},
    "particles": 2000,
    "truth_particles": 200,
}
SETTINGS = {
    "simulator": {"subparticles": 1, "grid_nodes": 65536, "memory_mb": 16},
    "reconstruct": {"gaussians": 150, "hull_resolution": 24, "iterations": 20, "width": 16, "depth": 1},
    "trajectory": {"particle_count": 200, "fill_resolution": 24, "iterations": 5},
    "identify": {"law": "neo_hookean", "contact": "sticky", "search_particles": 150, "processes": 1},
}
BALLS = Path(__file__).resolve().parents[1] / "tests" / "golden" / "balls"


@dataclass(frozen=True)
class Case:
    """``command``: words with {scene}, {run}, {tracks}, {out} and {dir} filled in. ``change`` breaks something in the
    case's folder. goes_on: the command says what it dropped, and ends with exit code 0. code: that is expected."""

    group: str
    name: str
    command: str
    change: Callable[[Path], Any] = lambda folder: None
    goes_on: bool = False
    code: int = 2
    disk: str = ""


@dataclass(frozen=True)
class Outcome:
    code: int | None
    said: str
    left: tuple[str, ...]
    traceback: bool
    seconds: float
    memory_mb: float

    def passes(self, case: Case) -> bool:
        """Whether the command did what is asked of it."""
        right = self.code == (0 if case.goes_on else case.code) and bool(self.said)
        return right and not self.left and not self.traceback and self.memory_mb < MEMORY_LIMIT_MB


# ---- changes of a scene ---------------------------------------------------------------------------------------------


def listing(change: Callable[[list[dict[str, Any]]], Any]) -> Callable[[Path], None]:
    """Change the rows of all_data.json."""

    def act(folder: Path) -> None:
        path = folder / "scene" / "all_data.json"
        rows = json.loads(path.read_text())
        rows = change(rows) or rows
        path.write_text(json.dumps(rows))

    return act


def of_view(view: int, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if f"r_{view}_" in row["file_path"]]


def every(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def act(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            change(row)

    return listing(act)


def same_cameras(rows: list[dict[str, Any]]) -> None:
    for row in of_view(1, rows):
        row["c2w"] = rows[0]["c2w"]


def looks_away(rows: list[dict[str, Any]]) -> None:
    for row in of_view(1, rows):
        pose = np.array(row["c2w"])
        pose[:, [0, 2]] *= -1
        row["c2w"] = pose.tolist()


def millimetres(row: dict[str, Any]) -> None:
    pose = np.array(row["c2w"])
    pose[:, 3] *= 1e3
    row["c2w"] = pose.tolist()


def digits_in_pose(row: dict[str, Any]) -> None:
    row["c2w"][0][3] = 10**400


def intrinsic(i: int, j: int, value: float) -> Callable[[dict[str, Any]], None]:
    def change(row: dict[str, Any]) -> None:
        row["intrinsic"][i][j] = value

    return change


def rate(fps: float) -> Callable[[dict[str, Any]], None]:
    def change(row: dict[str, Any]) -> None:
        row["time"] = row["time"] * 24 / fps

    return change


def time_stamps(folder: Path) -> None:
    path = folder / "scene" / "all_data.json"
    rows = json.loads(path.read_text())
    for row in rows:
        old = row["file_path"]
        view, frame = Path(old).stem.split("_")[1:]
        if int(frame) >= 0:
            row["file_path"] = f"./data/r_{view}_{1_700_000_000 + int(frame)}.png"
            os.rename(folder / "scene" / old, folder / "scene" / row["file_path"])
    path.write_text(json.dumps(rows))


def masks(value: int | None, *, size: int = 0, frame: str = "*") -> Callable[[Path], None]:
    """All cut-outs with one value (255: empty), or with an object of ``size`` pixels."""

    def act(folder: Path) -> None:
        for path in (folder / "scene" / "data").glob(f"m_*_{frame}.png"):
            picture = cv2.imread(str(path.with_name(path.name.replace("m_", "r_"))))
            assert picture is not None
            if value is not None:
                picture = np.full_like(picture, value)
            if size:
                kept = picture.copy()
                picture[:] = 255
                kept[kept == 255] = 254
                middle = picture.shape[0] // 2
                picture[middle : middle + size, middle : middle + size] = 30
            cv2.imwrite(str(path), picture)

    return act


def scene_yaml(text: str, where: str = "scene") -> Callable[[Path], None]:
    return lambda folder: (folder / where / "scene.yaml").write_text(text)


def png_header(width: int, height: int) -> bytes:
    """A PNG whose header says width × height and that holds no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def huge_pictures(width: int, height: int) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        for path in (folder / "scene" / "data").glob("r_0_*.png"):
            path.write_bytes(png_header(width, height))

    return act


def nerfstudio(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """The scene with a transforms.json in place of its own listing."""

    def act(folder: Path) -> None:
        path = folder / "scene" / "all_data.json"
        rows = json.loads(path.read_text())
        k = rows[0]["intrinsic"]
        frames = [
            {
                "file_path": row["file_path"],
                "mask_path": row["file_path"].replace("r_", "m_"),
                "transform_matrix": [*row["c2w"], [0, 0, 0, 1]],
                "time": row["time"],
            }
            for row in rows
            if "_-1" not in row["file_path"]
        ]
        content = {"fl_x": k[0][0], "fl_y": k[1][1], "cx": k[0][2], "cy": k[1][2], "w": 48, "h": 48, "frames": frames}
        path.unlink()
        (path.parent / "transforms.json").write_text(json.dumps(change(content) or content))

    return act


def clouds(change: Callable[[Path], Any]) -> Callable[[Path], None]:
    """Two point clouds in place of the scene."""

    def act(folder: Path) -> None:
        scene = folder / "scene"
        shutil.rmtree(scene)
        scene.mkdir()
        (scene / "scene.yaml").write_text("fps: 24\n")
        points = np.random.default_rng(0).normal(size=(100, 3))
        rows = "\n".join(" ".join(f"{v:.4f}" for v in p) for p in points)
        head = "ply\nformat ascii 1.0\nelement vertex 100\nproperty float x\nproperty float y\nproperty float z\n"
        for frame in range(2):
            (scene / f"cloud_{frame}.ply").write_text(f"{head}end_header\n{rows}\n")
        change(scene)

    return act


# ---- changes of files -----------------------------------------------------------------------------------------------


def cut(name: str, share: float = 0.5) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * share)])

    return act


def flip(name: str) -> Callable[[Path], None]:
    """Other bytes in the middle third."""

    def act(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        third = len(data) // 3
        data[third : 2 * third] = np.random.default_rng(1).integers(0, 256, third, dtype=np.uint8).tobytes()
        (folder / name).write_bytes(bytes(data))

    return act


def write(name: str, data: str | bytes) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)

    return act


def pipe(name: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.mkfifo(folder / name)

    return act


def arrays(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        with np.load(folder / name) as file:
            held = {key: file[key] for key in file.files}
        change(held)
        np.savez(folder / name, **held)

    return act


def document(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """Change a YAML file by hand."""

    def act(folder: Path) -> None:
        data = yaml.safe_load((folder / name).read_text())
        data = change(data) or data
        (folder / name).write_text(yaml.safe_dump(data, sort_keys=False))

    return act


def put(*keys: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


def interrupted(data: bytes | dict[str, Any]) -> Callable[[Path], None]:
    """As a run that was killed in identify, with a checkpoint that holds ``data``."""

    def act(folder: Path) -> None:
        document("run/run.yaml", lambda d: d["stages"]["identify"].update(state="running"))(folder)
        path = folder / "run" / "checkpoints" / "identify.pt"
        path.parent.mkdir(exist_ok=True)
        if isinstance(data, bytes):
            path.write_bytes(data)
        else:
            import torch

            torch.save(data, path)

    return act


def truth(change: Callable[[Path], Any]) -> Callable[[Path], None]:
    return lambda folder: change(folder / "scene" / "gt")


def moved_truth(gt: Path) -> None:
    for path in gt.glob("*.npy"):
        np.save(path, np.load(path) + 3.0)


def c3d(share: float) -> Callable[[Path], None]:
    """A scene of one C3D file that ends after ``share`` of its data."""

    def act(folder: Path) -> None:
        import c3d as library

        writer = library.Writer(point_rate=100.0)
        writer.set_point_labels(["tip"])
        for k in range(200):
            point = np.array([[0.0, 0.0, 1000 - 4.9e-1 * k * k, 0.0, 0.0]])
            writer.add_frames([(point, np.zeros((0, 0)))])
        path = folder / "tracks" / "drop.c3d"
        with path.open("wb") as file:
            writer.write(file)
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])
        (folder / "tracks" / "scene.yaml").write_text(
            "layout: tracks\nunits: mm\nbodies: {ball: {mass: 1}}\nruns: [{file: drop.c3d}]\n"
        )

    return act


def table(text: str, runs: str = "{file: a.csv}", more: str = "") -> Callable[[Path], None]:
    """A scene of tracks with one CSV."""

    def act(folder: Path) -> None:
        (folder / "tracks" / "a.csv").write_text(text)
        (folder / "tracks" / "scene.yaml").write_text(
            f"layout: tracks\nbodies: {{ball: {{mass: 1}}}}\nruns: [{runs}]\n{more}"
        )

    return act


ROWS = "time_s,a_x_m,a_y_m,a_z_m\n" + "".join(f"{k / 100},0,0,{1 - 4.9e-4 * k * k}\n" for k in range(40))
NO_Z = "time_s,a_x_m,a_y_m,a_z_m,b_x_m,b_y_m\n" + "".join(f"{k / 100},0,0,{1 - k},1,1\n" for k in range(40))
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(8)
)
CUBE = "solid\n" + "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
DIGITS = "7" * 400
SYNTH = "synth {dir}/spec.yaml --out {out}"
INSPECT = "inspect {scene} --out {dir}/sheet.png"
NEW = "reconstruct {scene} --out {out} --config {dir}/tiny.yaml"
AGAIN = "identify {scene} --out {run} --config {dir}/tiny.yaml"
EVALUATE = "evaluate {run} --truth {scene}/gt"
SIMULATE = "simulate {run} --frames 3 --out {out}"
TRACKS = "inspect {tracks} --out {dir}/sheet.png"


def spec(**changes: Any) -> Callable[[Path], None]:
    return lambda folder: (folder / "spec.yaml").write_text(yaml.safe_dump({**SPEC, **changes}))


def files_of_a_run() -> Iterator[Case]:
    group = "files of a run"
    for name, command in (
        ("trajectory.npz", EVALUATE),
        ("gaussians.ply", EVALUATE),
        ("deformation.safetensors", EVALUATE),
        ("calibration.json", EVALUATE),
        ("law.safetensors", SIMULATE),
        ("particles.safetensors", SIMULATE),
        ("twin.yaml", SIMULATE),
        ("run.yaml", SIMULATE),
    ):
        yield Case(group, f"{name} cut in half", command, cut(f"run/{name}"))
        yield Case(group, f"{name} with other bytes", command, flip(f"run/{name}"))
        yield Case(group, f"{name} empty", command, write(f"run/{name}", b""))
        yield Case(group, f"{name} is a FIFO", command, pipe(f"run/{name}"))
    for name, change in (
        ("cut in half", cut("run/rollout.npz")),
        ("with other bytes", flip("run/rollout.npz")),
        ("with NaN", arrays("run/rollout.npz", lambda a: a.update(positions=a["positions"] * np.nan))),
        ("with another shape", arrays("run/rollout.npz", lambda a: a.update(positions=a["positions"][0]))),
    ):
        yield Case(group, f"rollout.npz {name}", EVALUATE, change, goes_on=True)
    for name, change in (
        ("with NaN", lambda a: a.update(positions=a["positions"] * np.nan)),
        ("with another shape", lambda a: a.update(positions=a["positions"][:, 0])),
        ("with a volume of −1", lambda a: a.update(volume=-1.0)),
        ("of objects", lambda a: a.update(positions=np.array([{}], object))),
        ("with network settings that are no JSON", lambda a: a.update(network_settings="{")),
    ):
        yield Case(group, f"trajectory.npz {name}", EVALUATE, arrays("run/trajectory.npz", change))
    yield Case(group, "material.json cut in half", AGAIN, cut("run/material.json"), goes_on=True)
    for name, data in (
        ("of random bytes", bytes(range(256)) * 20),
        ("empty", b""),
        ("of another stage", {"iteration": 3}),
    ):
        yield Case(group, f"checkpoint {name}", AGAIN, interrupted(data), goes_on=True)


def edited_by_hand() -> Iterator[Case]:
    group = "run.yaml, twin.yaml by hand"
    run = "run/run.yaml"
    for name, change in (
        ("config: unknown key", put("config", "reconstruct", "iteratoins", value=3)),
        ("config: NaN", put("config", "simulator", "courant_number", value=float("nan"))),
        ("config: a text", put("config", value="standard")),
        ("split: fit_frames 'all'", put("split", "fit_frames", value="all")),
        ("split: fit_frames −1", put("split", "fit_frames", value=-1)),
        ("split: holdout_cameras 3", put("split", "holdout_cameras", value=3)),
        ("split: unknown camera", put("split", "holdout_cameras", value=[99])),
        ("stages: a list", put("stages", value=[])),
        ("stages: without identify", lambda d: d["stages"].pop("identify") and None),
        ("stages: state 'finished'", put("stages", "identify", "state", value="finished")),
        ("stages: seconds NaN", put("stages", "identify", "seconds", value=float("nan"))),
        ("scene: a number", put("scene", value=3)),
        ("scene: no path", lambda d: d["scene"].pop("path") and None),
        ("schema 99", put("schema", value=99)),
        ("a list", lambda d: [1, 2]),
    ):
        yield Case(group, f"run.yaml: {name}", SIMULATE, document(run, change))
    twin = "run/twin.yaml"
    for name, change in (
        ("volume −1", put("bodies", 0, "volume", "value", value=-1.0)),
        ("volume NaN", put("bodies", 0, "volume", "value", value=float("nan"))),
        ("volume 1e300", put("bodies", 0, "volume", "value", value=1e300)),
        ("volume not that of the particles", put("bodies", 0, "volume", "value", value=40.0)),
        ("density 1e300", put("bodies", 0, "density", "value", value=1e300)),
        ("density as text", put("bodies", 0, "density", "value", value="1000")),
        ("contact 'glue'", put("boundary", "contact", value="glue")),
        ("friction 1e300", put("boundary", "friction", value=1e300)),
        ("up of length 0", put("up", value=[0.0, 0.0, 0.0])),
        ("up of length 2", put("up", value=[0.0, 2.0, 0.0])),
        ("ground normal 0", put("boundary", "ground", "normal", value=[0.0, 0.0, 0.0])),
        ("ground far above", put("boundary", "ground", "height", "value", value=50.0)),
        ("gravity 1e300", put("gravity", "value", value=[0.0, -1e300, 0.0])),
        ("velocity 1e30", put("initial_conditions", 0, "velocity", "value", value=[1e30, 0.0, 0.0])),
        ("fps 1e300", put("initial_conditions", 0, "fps", value=1e300)),
        ("fps true", put("initial_conditions", 0, "fps", value=True)),
        ("no bodies", put("bodies", value=[])),
        ("unknown body", put("initial_conditions", 0, "body", value="nobody")),
        ("unknown key", put("colour", value="red")),
        ("unknown effect", put("effects", value=[{"effect": "magic", "parameters": {}}])),
        ("law in another folder", put("bodies", 0, "law", "file", value="../../../etc/passwd")),
        ("another law's parameter", put("bodies", 0, "law", "parameters", "youngs_modulus", "value", value=1.0)),
        ("simulator.subparticles 3", put("simulator", "subparticles", value=3)),
        ("fit is a list", put("fit", value=[])),
    ):
        yield Case(group, f"twin.yaml: {name}", SIMULATE, document(twin, change))


def texts() -> Iterator[Case]:
    group = "YAML and JSON"
    config = "inspect {scene} --out {dir}/sheet.png --config {dir}/c.yaml"
    for name, text in (
        ("a key twice", "seed: 1\nseed: 2\n"),
        ("400 digits", f"seed: {DIGITS}\n"),
        ("5000 digits", f"seed: {DIGITS * 13}\n"),
        ("a date that does not exist", "seed: 2024-99-99\n"),
        ("nested 5000 deep", f"seed: {'[' * 5000}{']' * 5000}\n"),
        ("aliases of aliases", BOMB),
        ("an alias of itself", "seed: &a [*a]\n"),
        ("a Python object", "seed: !!python/object/apply:os.system [ls]\n"),
        ("bytes", b"\xff\xfe\x00"),
        ("NaN", "simulator: {courant_number: .nan}\n"),
        ("a list", "- 1\n"),
        ("a directory", None),
    ):
        change = (lambda f: (f / "c.yaml").mkdir()) if text is None else write("c.yaml", text)
        yield Case(group, f"--config: {name}", config, change)
    yield Case(group, "--config is a FIFO", config, pipe("c.yaml"))
    yield Case(group, "scene.yaml is a FIFO", INSPECT, pipe("scene/scene.yaml"))
    yield Case(group, "scene.yaml: fps twice", INSPECT, scene_yaml("fps: 24\nfps: 30\n"))
    yield Case(group, "all_data.json nested deep", INSPECT, write("scene/all_data.json", "[" * 100000))
    yield Case(group, "all_data.json: 5000 digits", INSPECT, write("scene/all_data.json", f"[{DIGITS * 13}]"))
    yield Case(group, "all_data.json: time of 400 digits", INSPECT, every(lambda r: r.update(time=int(DIGITS))))
    yield Case(group, "all_data.json: pose of 400 digits", INSPECT, every(digits_in_pose))
    yield Case(group, "all_data.json: file_path is a number", INSPECT, every(lambda r: r.update(file_path=3)))
    yield Case(group, "all_data.json: frame of 400 digits", INSPECT,
               listing(lambda rows: rows[-1].update(file_path=f"./data/r_0_{DIGITS}.png")))  # fmt: skip
    yield Case(group, "transforms.json: time of 400 digits", INSPECT,
               nerfstudio(lambda c: c["frames"][0].update(time=10**400)))  # fmt: skip
    yield Case(group, "transforms.json: matrix of 400 digits", INSPECT,
               nerfstudio(lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, 10**400)))  # fmt: skip


def scenes() -> Iterator[Case]:
    group = "scenes"
    for command, how in ((INSPECT, "inspect"), (NEW, "reconstruct")):
        shown = how == "inspect"
        for name, change in (
            ("masks of frame 0 are empty", masks(255, frame="0")),
            ("masks of frame 0 are one pixel", masks(None, size=1, frame="0")),
            ("masks cover everything", masks(30)),
            ("one view", listing(lambda rows: of_view(0, rows))),
            ("a camera looks away", listing(looks_away)),
            ("poses in millimetres", every(millimetres)),
            ("ground metres above the object", scene_yaml("ground: {normal: [0, 1, 0], height: 5}\n")),
        ):
            yield Case(group, f"{name} ({how})", command, change, goes_on=shown)
    for name, change in (
        ("two identical cameras", listing(same_cameras)),
        ("principal point outside the picture", every(intrinsic(0, 2, 500.0))),
        ("last row of the intrinsics not 0 0 1", every(intrinsic(2, 0, 0.3))),
        ("skew below the diagonal", every(intrinsic(1, 0, 5.0))),
        ("focal length of 1e-3 pixels", every(intrinsic(0, 0, 1e-3))),
        ("1e-9 frames a second", every(rate(1e-9))),
        ("1e300 frames a second", every(rate(1e300))),
        ("scene.yaml: fps 1e300", scene_yaml("fps: 1.0e+300\n")),
        ("scene.yaml: fps 1e-9", scene_yaml("fps: 1.0e-9\n")),
        ("scene.yaml: density 1e300", scene_yaml("density: 1.0e+300\n")),
        ("scene.yaml: gravity 1e300", scene_yaml("gravity: 1.0e+300\n")),
        ("scene.yaml: ground at 1e300", scene_yaml("ground: {normal: [0, 1, 0], height: 1.0e+300}\n")),
        ("frame numbers are time stamps", time_stamps),
        ("pictures of 30000×30000 by their header", huge_pictures(30000, 30000)),
        ("pictures of 2³¹×2³¹ by their header", huge_pictures(2**31 - 1, 2**31 - 1)),
        ("pictures of 0×0 by their header", huge_pictures(0, 0)),
        ("a picture is cut", cut("scene/data/r_0_0.png")),
        ("a mask is cut", cut("scene/data/m_0_0.png", 0.3)),
    ):
        yield Case(group, name, INSPECT, change)
    yield Case(group, "a mask is a FIFO", INSPECT, pipe("scene/data/m_0_0.png"), goes_on=True)
    for name, change in (
        ("is a FIFO", lambda s: ((s / "cloud_1.ply").unlink(), os.mkfifo(s / "cloud_1.ply"))),
        ("is a time stamp", lambda s: os.rename(s / "cloud_1.ply", s / "cloud_1700000000.ply")),
        ("says 10¹² points", lambda s: (s / "cloud_0.ply").write_text(
            (s / "cloud_0.ply").read_text().replace("vertex 100", "vertex 1000000000000"))),
        ("is empty", lambda s: (s / "cloud_0.ply").write_text("")),
        ("has coordinates of 1e300", lambda s: (s / "cloud_0.ply").write_text(
            (s / "cloud_0.ply").read_text().replace("float", "double").replace("0.", "9e299 #")[:400])),
    ):  # fmt: skip
        yield Case(group, f"point cloud {name}", INSPECT, clouds(change))


def tracks() -> Iterator[Case]:
    group = "tracks"
    for name, change in (
        ("C3D cut after 60 %", c3d(0.6)),
        ("C3D cut after 10 %", c3d(0.1)),
        ("C3D of random bytes", lambda f: (c3d(1.0)(f), flip("tracks/drop.c3d")(f))),
        ("CSV with 1e300", table(ROWS.replace("0,0,1.0", "0,0,1e300"))),
        ("CSV with times of 1e300", table(ROWS.replace("0.39,", "1e300,"))),
        ("CSV with a 400-digit number", table(ROWS.replace("0,0,1.0", f"0,0,{DIGITS}"))),
        ("CSV is a FIFO", lambda f: (table(ROWS)(f), pipe("tracks/a.csv")(f))),
        ("CSV of NUL bytes", lambda f: (table(ROWS)(f), write("tracks/a.csv", b"\0" * 400)(f))),
        ("markers: []", table(ROWS, "{file: a.csv, markers: []}")),
        ("a marker without z", table(NO_Z)),
        ("medium_density 1e300", table(ROWS, more="medium_density: 1.0e+300\n")),
        ("mass 1e300", lambda f: (table(ROWS)(f), write("tracks/scene.yaml", (f / "tracks/scene.yaml").read_text()
                                                        .replace("mass: 1", "mass: 1.0e+300"))(f))),
        ("sphere of 1e300", lambda f: write("tracks/scene.yaml", (
            "layout: tracks\nbodies: {b: {density: 1, geometry: {units: m, sphere: 1.0e+300}}}\n"
            "runs: [{file: drops.csv, select: {ball: heavy, drop: 1}}]\n"))(f)),
        ("a run outside of time", table(ROWS, "{file: a.csv, time: [5, 6]}")),
        ("rest_frames of 400 digits", table(ROWS, f"{{file: a.csv, rest_frames: [0, {DIGITS}]}}")),
    ):  # fmt: skip
        yield Case(group, name, TRACKS, change)


def options() -> Iterator[Case]:
    group = "options"
    for name, command in (
        ("--law typo", "identify {scene} --out {out} --config {dir}/tiny.yaml --law typo"),
        ("--geometry-loss typo", "identify {scene} --out {out} --config {dir}/tiny.yaml --geometry-loss typo"),
        ("--arch typo", "inspect {scene} --arch typo --config {dir}/tiny.yaml"),
        ("--seed −1", "inspect {scene} --seed -1"),
        ("--seed of 400 digits", f"inspect {{scene}} --seed {DIGITS}"),
        ("--velocity=1e30,0,0", SIMULATE + " --velocity=1e30,0,0"),
        ("--velocity=nan,0,0", SIMULATE + " --velocity=nan,0,0"),
        ("--omega=1e30,0,0", SIMULATE + " --omega=1e30,0,0"),
        ("--gravity=1e30,0,0", SIMULATE + " --gravity=1e30,0,0"),
        ("--density 1e300", SIMULATE + " --density 1e300"),
        ("--density 1e-300", SIMULATE + " --density 1e-300"),
        ("--ground 1e300", SIMULATE + " --ground 1e300"),
        ("--ground −1e300", SIMULATE + " --ground=-1e300"),
        ("--force=1e300,0,0", SIMULATE + " --force=1e300,0,0"),
        ("--force-from nan", SIMULATE + " --force=1,0,0 --force-from nan"),
        ("--blend 7", SIMULATE + " --law {run} --blend 7"),
        ("--frames 10¹²", "simulate {run} --frames 1000000000000 --out {out}"),
        ("--frames of 400 digits", f"simulate {{run}} --frames {DIGITS} --out {{out}}"),
        ("--law NOT_A_RUN", SIMULATE + " --law {scene}"),
        ("--truth NOT_A_FOLDER", "evaluate {run} --truth {dir}/nowhere"),
        ("evaluate without --truth", "evaluate {run}"),
        ("identify --also NOT_A_RUN", "identify {scene} --out {out} --also {dir}/nowhere"),
    ):
        yield Case(group, name, command)
    for name, file, data in (
        ("text", "m.stl", "no mesh"),
        ("one triangle", "m.stl", CUBE + "endsolid\n"),
        ("empty", "m.ply", b""),
        ("a picture", "m.png", png_header(1, 1)),
        ("an .obj without faces", "m.obj", "v 0 0 0\nv 1 0 0\n"),
        ("an .stl that says 4·10⁹ faces", "m.stl", b"\0" * 80 + struct.pack("<I", 2**32 - 1)),
        ("an .obj with NaN", "m.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ):
        yield Case(group, f"--geometry: {name}", SIMULATE + f" --geometry {{dir}}/{file}", write(file, data))
    yield Case(group, "--geometry is a FIFO", SIMULATE + " --geometry {dir}/m.stl", pipe("m.stl"))
    yield Case(group, "--geometry is a folder without a run", SIMULATE + " --geometry {scene}")


def truths() -> Iterator[Case]:
    group = "truth of evaluate"
    for name, change, goes_on in (
        ("one file is empty", lambda gt: (gt / "particles_2.npy").write_bytes(b""), False),
        ("one array is empty", lambda gt: np.save(gt / "particles_0.npy", np.zeros((0, 3))), False),
        ("a NaN", lambda gt: np.save(gt / "particles_1.npy", np.load(gt / "particles_1.npy") * np.nan), False),
        ("of text", lambda gt: np.save(gt / "particles_0.npy", np.full((9, 3), "a")), False),
        ("complex", lambda gt: np.save(gt / "particles_0.npy", np.full((200, 3), 1j)), False),
        ("objects", lambda gt: np.save(gt / "particles_0.npy", np.array([{}], object), allow_pickle=True), False),
        ("of another scene", moved_truth, False),
        ("frame 2 is missing", lambda gt: (gt / "particles_2.npy").unlink(), False),
        ("the last frame is missing", lambda gt: (gt / "particles_3.npy").unlink(), True),
        ("of one particle", lambda gt: [np.save(p, np.load(p)[:1]) for p in gt.glob("*.npy")], False),
        ("a header of 10¹² rows", lambda gt: (gt / "particles_0.npy").write_bytes(
            b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }"
            .ljust(117) + b"\n"), False),
    ):  # fmt: skip
        yield Case(group, name, EVALUATE, truth(change), goes_on=goes_on)


def outputs() -> Iterator[Case]:
    group = "--out"
    file = write("taken", "a file")
    for name, command, change in (
        ("below a file", "simulate {run} --frames 3 --out {dir}/taken/x", file),
        ("is a file", "simulate {run} --frames 3 --out {dir}/taken", file),
        ("below a file (reconstruct)", "reconstruct {scene} --out {dir}/taken/x --config {dir}/tiny.yaml", file),
        ("below a file (inspect)", "inspect {scene} --out {dir}/taken/x.png", file),
        ("a folder (inspect)", "inspect {scene} --out {scene}", file),
        ("below a file (synth)", "synth {dir}/spec.yaml --out {dir}/taken/x", spec()),
        ("in /proc", "simulate {run} --frames 3 --out /proc/masiv", file),
        ("in /proc (synth)", "synth {dir}/spec.yaml --out /proc/masiv", spec()),
        ("a name of 300 characters", "simulate {run} --frames 3 --out {dir}/" + "x" * 300, file),
        ("a name of 300 characters (synth)", "synth {dir}/spec.yaml --out {dir}/" + "x" * 300, spec()),
    ):
        change_all = (lambda c: lambda f: (file(f), c(f)))(change)
        yield Case(group, name, command, change_all)
    for disk, code in (("read-only", 2), ("full", 1)):
        for command in ("simulate {run} --frames 3 --out {disk}/x", "synth {dir}/spec.yaml --out {disk}/x",
                        "reconstruct {scene} --out {disk}/x --config {dir}/tiny.yaml",
                        "inspect {scene} --out {disk}/x.png"):  # fmt: skip
            yield Case(group, f"{disk} disk ({command.split()[0]})", command, spec(), code=code, disk=disk)


def syntheses() -> Iterator[Case]:
    group = "synth"
    for name, change in (
        ("density 1e300", spec(material={**SPEC["material"], "density": 1e300})),  # type: ignore[dict-item]
        ("fps 1e300", spec(fps=1e300)),
        ("fps 1e-9", spec(fps=1e-9)),
        ("velocity 1e30", spec(velocity=[1e30, 0, 0])),
        ("gravity 1e30", spec(gravity=[0, -1e30, 0])),
        ("size 1e300", spec(shape={"size": 1e300})),
        ("modulus 1e30", spec(material={"parameters": {"youngs_modulus": 1e30, "poissons_ratio": 0.3}})),
        ("Poisson's ratio 0.7", spec(material={"parameters": {"youngs_modulus": 1e4, "poissons_ratio": 0.7}})),
        ("an unknown law", spec(material={"law": "rubber", "parameters": {}})),
        ("a parameter of another law", spec(material={"parameters": {"viscosity": 3.0}})),
        ("an unknown effect", spec(effects={"magic": {}})),
        ("an effect out of bounds", spec(effects={"linear_drag": {"rate": -1e300}})),
        ("10⁹ frames", spec(frames=10**9)),
        ("10¹² particles", spec(particles=10**12)),
        ("a mesh that is text", lambda f: (spec(shape={"kind": "mesh", "mesh": "m.stl"})(f), write("m.stl", "x")(f))),
        ("cameras inside the body", spec(cameras={"count": 4, "size": 48, "distance": 0.01})),
        ("camera above its target", spec(cameras={"count": 4, "size": 48, "distance": 1e-9, "target": [0, 0, 0]})),
        ("a key twice", lambda f: write("spec.yaml", "fps: 24\nfps: 25\n")(f)),
    ):
        yield Case(group, name, SYNTH, change)


def cases() -> list[Case]:
    """All of them."""
    makers = (files_of_a_run, edited_by_hand, texts, scenes, tracks, options, truths, outputs, syntheses)
    return [case for maker in makers for case in maker()]


# ---- running --------------------------------------------------------------------------------------------------------


def prepare(work: Path) -> None:
    """A scene, its run and a copy of the tracks in ``work``, if they are missing."""
    work.mkdir(parents=True, exist_ok=True)
    (work / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    (work / "tiny.yaml").write_text(yaml.safe_dump(SETTINGS))
    if not (work / "tracks").is_dir():
        shutil.copytree(BALLS, work / "tracks")
    for made, words in (
        (work / "scene", ["synth", work / "spec.yaml", "--out", work / "scene"]),
        (work / "run" / "report.html",
         ["identify", work / "scene", "--out", work / "run", "--config", work / "tiny.yaml"]),
    ):  # fmt: skip
        if not made.exists():
            code = "from masiv.cli.main import run; run()"
            subprocess.run([sys.executable, "-c", code, *map(str, words)], check=True, stdout=subprocess.DEVNULL)


@contextmanager
def disk(kind: str, folder: Path) -> Iterator[bool]:
    """A small file system at ``folder``, full or read-only. Yields whether it could be mounted."""
    folder.mkdir()
    size = "size=8k" if kind == "full" else "ro"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", folder], capture_output=True).returncode == 0
    try:
        if mounted and kind == "full":
            (folder / "other").write_bytes(b"0" * 4096)
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", folder], check=True)


def run(case: Case, work: Path) -> Outcome | None:
    """Break a copy of what is in ``work`` and run the command; None if the disk cannot be had."""
    with tempfile.TemporaryDirectory(prefix="masiv-bad-") as name:
        folder = Path(name)
        for part in ("scene", "run", "tracks"):
            shutil.copytree(work / part, folder / part)
        shutil.copy(work / "tiny.yaml", folder)
        record = folder / "run" / "run.yaml"
        record.write_text(record.read_text().replace(str(work / "scene"), str(folder / "scene")))
        case.change(folder)
        places = {part: folder / part for part in ("scene", "run", "tracks", "out", "disk")} | {"dir": folder}
        words = [word.format(**places) for word in case.command.split()]
        if not case.disk:
            return _ended(words, folder)
        with disk(case.disk, folder / "disk") as mounted:
            return _ended(words, folder) if mounted else None


def _ended(words: list[str], folder: Path) -> Outcome:
    out, err = folder.with_suffix(".out"), folder.with_suffix(".err")
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(words, folder, out, err)
    code, usage = None, None
    while usage is None:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            code, usage = os.waitstatus_to_exitcode(status), used
        elif time.monotonic() - began > TIME_LIMIT_S:
            os.killpg(child, signal.SIGKILL)
            _, _, usage = os.wait4(child, 0)
        else:
            time.sleep(0.02)
    said, printed = err.read_text(errors="replace"), out.read_text(errors="replace")
    out.unlink()
    err.unlink()
    told = [line for line in said.splitlines() if line.startswith("error: ")]
    told = told or [line for line in said.splitlines() if "arning: " in line]
    told = told or [line[4:] for line in printed.splitlines() if line.startswith("  - ")]  # problems of a scene
    left = tuple(sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if ".tmp" in p.name))
    text = "hangs" if code is None else " ".join(told).replace(str(folder), "…")
    return Outcome(code, text, left, "Traceback" in said, time.monotonic() - began, usage.ru_maxrss / 1024)


def _become(words: list[str], folder: Path, out: Path, err: Path) -> None:
    """The command, in a process that has the imports already."""
    os.setsid()
    os.chdir(folder)
    for path, descriptor in ((out, 1), (err, 2)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), descriptor)
    sys.argv = ["masiv", *words]
    code = 1
    try:
        from masiv.cli.main import run as masiv

        masiv()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(code)


def row(case: Case, outcome: Outcome, length: int) -> str:
    """A row of the table, with at most ``length`` characters of the sentence."""
    said = outcome.said or "(nothing)"
    said = said.removeprefix("error: ").split("arning: ")[-1].replace("|", "\\|")
    verdict = "" if outcome.passes(case) else " **no**"
    if outcome.traceback:
        verdict += " traceback"
    if outcome.left:
        verdict += f" left {', '.join(outcome.left)}"
    if outcome.memory_mb >= MEMORY_LIMIT_MB:
        verdict += f" {outcome.memory_mb:.0f} MB"
    return f"| {case.name} | {outcome.code}{verdict} | {said[:length]}{'…' if len(said) > length else ''} |"


def page(found: list[tuple[Case, Outcome]]) -> str:
    """Counts by group, and a table of the sentences; of those that have the same form, the first one of its group."""
    groups = list(dict.fromkeys(case.group for case, _ in found))
    lines = [
        "| group | cases | as expected | refused (2) | failed (1) | goes on with a word (0) |",
        "|---|---|---|---|---|---|",
    ]
    for group in [*groups, ""]:
        own = [(case, outcome) for case, outcome in found if group in ("", case.group)]
        good = sum(outcome.passes(case) for case, outcome in own)
        codes = [sum(outcome.code == code for _, outcome in own) for code in (2, 1, 0)]
        lines.append(f"| {group or '**all**'} | {len(own)} | {good} | {codes[0]} | {codes[1]} | {codes[2]} |")
    for group in groups:
        lines += ["", f"### {group[0].upper()}{group[1:]}", "", "| case | exit | says |", "|---|---|---|"]
        known: set[str] = set()
        for case, outcome in found:
            form = re.sub(r"(\S*/)+|[^a-z ]", "", outcome.said)[:45]
            if case.group == group and (form not in known or not outcome.passes(case)):
                lines.append(row(case, outcome, 48))
            known |= {form} if case.group == group else set()
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "masiv-bad-inputs")
    parser.add_argument("--only", default="", help="cases whose group or name contains this")
    parser.add_argument("--out", type=Path, help="write the tables there")
    options_ = parser.parse_args()
    prepare(options_.work)
    import torch  # noqa: F401

    import masiv.cli.main  # what every command imports, once
    import masiv.pipeline.video
    import masiv.synth.synthesise  # noqa: F401

    found = []
    for case in cases():
        outcome = run(case, options_.work) if options_.only in f"{case.group}: {case.name}" else None
        if outcome is not None:
            found.append((case, outcome))
            print(f"{outcome.seconds:5.1f} s {outcome.memory_mb:5.0f} MB {row(case, outcome, 160)}", flush=True)
    passed = sum(outcome.passes(case) for case, outcome in found)
    print(f"{passed} of {len(found)}")
    if options_.out is not None:
        options_.out.write_text(page(found), encoding="utf-8")
    sys.exit(0 if passed == len(found) else 1)


if __name__ == "__main__":
    main()
