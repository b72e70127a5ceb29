"""Ways in which a scene, a run or tracks are broken, each a function of the case's folder."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

SPEC = {
    "shape": {"kind": "cube", "size": 0.4, "rotation_deg": [20, 30, 0], "clearance": 0.25},
    "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 4e4, "poissons_ratio": 0.3}},
    "velocity": [0.5, -1.5, 0.0],
    "frames": 4,
    "cameras": {"count": 4, "size": 48, "field_of_view_deg": 28},
    "particles": 2000,
    "truth_particles": 200,
}


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


def spec(**changes: Any) -> Callable[[Path], None]:
    return lambda folder: (folder / "spec.yaml").write_text(yaml.safe_dump({**SPEC, **changes}))
