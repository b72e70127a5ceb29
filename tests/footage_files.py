"""Footage on disk with a known answer: the soft dot of ``tiny_scenes``, filmed by cameras whose clocks differ, and the
calibration of these cameras in each format, written from the formats' descriptions."""

from __future__ import annotations

import json
import struct
import subprocess
import wave
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import tiny_scenes as tiny
from scipy.spatial.transform import Rotation

FPS, SECONDS, COMMON = 30.0, 1.0, 0.5
"""Rate of recording; of the motion: common time 0 … 0.5 s has the dot in view, which moves on from dot(0) to dot(3)."""
NAMES = ("left", "middle", "right")
STARTS = (0.0, -0.3, -0.7)
"""Common time of the first picture of each camera [s]."""
GREY, OBJECT = 90.0, tiny.COLOUR


def dot(time: float) -> np.ndarray:
    """Where the dot is at a common time [s], shape (3,) [m]; it stands still before 0 and after COMMON."""
    return tiny.dot(3 * float(np.clip(time, 0, COMMON)) / COMMON)


def world_to_camera(view: int) -> np.ndarray:
    """OpenCV axes."""
    return np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(tiny.pose(view))


def picture(where: np.ndarray | None, light: float = 0.0, background=(GREY, GREY, GREY)) -> np.ndarray:
    """RGB (H, W, 3) uint8 of the dot at pixel ``where``, or of the empty scene; ``light`` is added."""
    share = np.zeros((tiny.HEIGHT, tiny.WIDTH)) if where is None else tiny.cover(where)
    pixels = share[..., None] * OBJECT + (1 - share[..., None]) * np.array(background) + light
    return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def filmed(view: int, times, *, light=lambda time: 0.0, distortion=None, background=(GREY, GREY, GREY)):
    """The pictures that camera ``view`` takes at common ``times`` [s]."""
    for time in times:
        yield picture(tiny.pixel(view, dot(time), tiny.K, distortion), light(time), background)


def own_times(view: int, count: int | None = None, fps: float = FPS) -> np.ndarray:
    """Common times of the pictures of ``view``: until 0.3 s after the motion."""
    count = count or round((COMMON + 0.3 - STARTS[view]) * fps)
    return STARTS[view] + np.arange(count) / fps


def write_pictures(folder: Path, pictures, name="{:04d}.png") -> Path:
    folder.mkdir(parents=True)
    for k, pixels in enumerate(pictures):
        assert cv2.imwrite(str(folder / name.format(k)), pixels[..., ::-1])
    return folder


def write_video(path: Path, pictures, fps: float = FPS, sound: np.ndarray | None = None) -> Path:
    """H.264; ``sound`` float32 at 48 kHz from the first picture on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    silent = path.with_name(f"{path.stem}_silent.mp4") if sound is not None else path
    writer = None
    for pixels in pictures:
        if writer is None:
            size = pixels.shape[1], pixels.shape[0]
            writer = imageio_ffmpeg.write_frames(
                str(silent), size, fps=fps, quality=10, macro_block_size=2, ffmpeg_log_level="error"
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(pixels).tobytes())
    assert writer is not None
    writer.close()
    if sound is not None:
        track = path.with_suffix(".wav")
        with wave.open(str(track), "wb") as file:
            file.setnchannels(1)
            file.setsampwidth(2)
            file.setframerate(48_000)
            file.writeframes((np.clip(sound, -1, 1) * 32767).astype("<i2").tobytes())
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", silent, "-i", track]
        subprocess.run([*map(str, command), "-c:v", "copy", "-c:a", "aac", "-b:a", "128k", str(path)], check=True)
        silent.unlink()
        track.unlink()
    return path


def footage(folder: Path, kind: str = "pictures", **how) -> Path:
    """A recording of each camera, ``kind`` pictures or video."""
    for view, name in enumerate(NAMES):
        pictures = filmed(view, own_times(view), **how)
        if kind == "video":
            write_video(folder / f"{name}.mp4", pictures)
        else:
            write_pictures(folder / name, pictures)
    return folder


# ------------------------------------------------------------------ calibrations

FISHEYE = (-0.2, 0.05, 0.01, -0.005)


def toml(path: Path, *, distortion=None, unit: float = 1.0, names=NAMES, extra: str = "") -> Path:
    """As aniposelib and Pose2Sim write it; ``unit``: metres of a unit. Pixel centres are whole numbers."""
    d = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, **(distortion or {})}
    text = ""
    for view, name in enumerate(names):
        pose = world_to_camera(view)
        vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        matrix = [[tiny.FOCAL_X, 0.0, tiny.CX - 0.5], [0.0, tiny.FOCAL_Y, tiny.CY - 0.5], [0.0, 0.0, 1.0]]
        text += (
            f'[cam_{view}]\nname = "{name}"\nsize = [ {tiny.WIDTH}, {tiny.HEIGHT},]\nmatrix = {matrix}\n'
            f"distortions = {[d['k1'], d['k2'], d['p1'], d['p2'], 0.0]}\nrotation = {vector.tolist()}\n"
            f"translation = {(pose[:3, 3] / unit).tolist()}\nfisheye = false\n{extra}\n"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "[metadata]\nadjusted = true\nerror = 0.2\n")
    return path


def transforms(path: Path, *, distortion=None) -> Path:
    lens = {"fl_x": tiny.FOCAL_X, "fl_y": tiny.FOCAL_Y, "cx": tiny.CX, "cy": tiny.CY, "w": tiny.WIDTH, "h": tiny.HEIGHT}
    frames = [
        {"file_path": f"images/{name}.jpg", "transform_matrix": tiny.pose(view).tolist()}
        for view, name in enumerate(NAMES)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    model = "OPENCV" if distortion else "PINHOLE"
    path.write_text(json.dumps({"camera_model": model, **lens, **(distortion or {}), "frames": frames}))
    return path


def colmap(
    folder: Path, *, binary: bool, model: str = "PINHOLE", unit: float = 1.0, more=(), picture_name="{}.png"
) -> Path:
    """https://colmap.github.io/format.html: the first picture has no points, the others have two."""
    folder.mkdir(parents=True)
    number = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7}[model]
    numbers = (tiny.FOCAL_X, tiny.FOCAL_Y, tiny.CX, tiny.CY, *more)
    rows = []
    for view, name in enumerate(NAMES):
        pose = world_to_camera(view)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(
            (view + 1, (w, x, y, z), pose[:3, 3] / unit, picture_name.format(name), [] if view == 0 else [1, 2])
        )
    if binary:
        camera = struct.pack(f"<iiQQ{len(numbers)}d", 7, number, tiny.WIDTH, tiny.HEIGHT, *numbers)
        (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
        data = struct.pack("<Q", len(rows))
        for key, quaternion, t, name, points in rows:
            data += struct.pack("<I7dI", key, *quaternion, *t, 7) + name.encode() + b"\0"
            data += struct.pack("<Q", len(points)) + b"".join(struct.pack("<ddq", 1.5, 2.5, -1) for _ in points)
        (folder / "images.bin").write_bytes(data)
    else:
        values = " ".join(map(repr, map(float, numbers)))
        (folder / "cameras.txt").write_text(
            f"# Camera list\n7 {model} {tiny.WIDTH} {tiny.HEIGHT} {values}\n", encoding="utf-8"
        )
        lines = ["# Image list"]
        for key, quaternion, t, name, points in rows:
            lines.append(f"{key} {' '.join(repr(float(v)) for v in (*quaternion, *t))} 7 {name}")
            lines.append(" ".join("1.5 2.5 -1" for _ in points))
        (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def _on_plane(view: int, point) -> tuple[float, float]:
    x, y, z = world_to_camera(view)[:3, :3] @ np.asarray(point) + world_to_camera(view)[:3, 3]
    return x / z, y / z


def fisheye_pixel(view: int, point) -> np.ndarray:
    """By hand, OpenCV's documentation of its fisheye model: theta_d = theta (1 + k1 theta² + …); centres at +0.5."""
    x, y = _on_plane(view, point)
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(FISHEYE)))
    return np.array([tiny.CX + tiny.FOCAL_X * bent / r * x, tiny.CY + tiny.FOCAL_Y * bent / r * y])


RATIONAL = (-0.3, 0.05, 0.002, -0.003, 0.01, 0.4, 0.02, 0.01)
"""k1, k2, p1, p2, k3, k4, k5, k6: the order of COLMAP's FULL_OPENCV."""


def rational_pixel(view: int, point) -> np.ndarray:
    """By hand, OpenCV's documentation of its rational model."""
    k1, k2, p1, p2, k3, k4, k5, k6 = RATIONAL
    x, y = _on_plane(view, point)
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.array([tiny.CX + tiny.FOCAL_X * u, tiny.CY + tiny.FOCAL_Y * v])


BENT = {"OPENCV_FISHEYE": (FISHEYE, fisheye_pixel), "FULL_OPENCV": (RATIONAL, rational_pixel)}
