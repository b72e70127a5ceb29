"""Tiny scenes on disk, one a layout: a soft dot that moves, drawn where a projection written by hand says."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FRAMES, VIEWS = 96, 80, 4, 3
CENTRE = np.array([0.05, 0.6, -0.1])
FOCAL_X, FOCAL_Y, CX, CY = 120.0, 124.0, 43.5, 46.0  # off the centre of the picture
K = [[FOCAL_X, 0, CX], [0, FOCAL_Y, CY], [0, 0, 1]]
DISTORTION = {"k1": -0.5, "k2": 0.3, "p1": 0.008, "p2": -0.012}
RADIUS, COLOUR = 3.0, np.array([200.0, 60, 30])


def dot(frame: int) -> np.ndarray:
    """Where the dot is, shape (3,) [m]."""
    return CENTRE + np.array([0.15 * frame - 0.25, 0.25 - 0.12 * frame, 0.03 * frame])


def pose(view: int) -> np.ndarray:
    """OpenGL camera-to-world (4, 4): x right, y up, looking along −z, about at CENTRE; no component of t is zero."""
    eye = CENTRE + np.array([0.7 * np.cos(view), 0.5 + 0.1 * view, 1.6 + 0.7 * np.sin(view)])
    back = (eye - CENTRE + 0.05) / np.linalg.norm(eye - CENTRE + 0.05)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return c2w


def pixel(view, point, k=K, distortion=None) -> np.ndarray:
    """By hand: OpenGL camera axes, pixel rows grow downwards, Brown–Conrady distortion (OpenCV's documentation)."""
    x, y, z = pose(view)[:3, :3].T @ (np.asarray(point) - pose(view)[:3, 3])
    x, y = x / -z, y / z
    d = {"k1": 0, "k2": 0, "p1": 0, "p2": 0, **(distortion or {})}
    r2 = x * x + y * y
    radial = 1 + d["k1"] * r2 + d["k2"] * r2 * r2
    u = x * radial + 2 * d["p1"] * x * y + d["p2"] * (r2 + 2 * x * x)
    v = y * radial + d["p1"] * (r2 + 2 * y * y) + 2 * d["p2"] * x * y
    return np.array([k[0][2] + k[0][0] * u, k[1][2] + k[1][1] * v])


def cover(where, width=WIDTH, height=HEIGHT) -> np.ndarray:
    """Share of each pixel (H, W) that a soft dot around the pixel coordinates ``where`` covers; centres at +0.5."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.clip(RADIUS + 0.5 - np.hypot(x - where[0], y - where[1]), 0, 1)


def draw(path: Path, alpha: np.ndarray | None, *, rgba: bool, background: float = 90.0) -> None:
    """Write the dot, cut out by alpha or before a plain background; None is the empty background."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if rgba:
        assert alpha is not None
        pixels = np.dstack([np.broadcast_to(COLOUR[::-1], (*alpha.shape, 3)), 255 * alpha])
    else:
        share = np.zeros((HEIGHT, WIDTH)) if alpha is None else alpha
        pixels = share[..., None] * COLOUR[::-1] + (1 - share[..., None]) * background
    assert cv2.imwrite(str(path), np.round(pixels).astype(np.uint8))


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean pixel coordinates of a mask, pixel centres at +0.5."""
    rows, columns = np.indices(mask.shape)
    return np.array([(mask * (columns + 0.5)).sum(), (mask * (rows + 0.5)).sum()]) / mask.sum()


def write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def edit_json(path: Path, change) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def springgaus_synthetic(folder: Path) -> Path:
    for view in range(VIEWS):
        for frame in range(FRAMES):
            draw(folder / f"cam_{view}" / f"{frame:03d}.png", cover(pixel(view, dot(frame))), rgba=True)
    write_json(folder / "camera.json", [{"camera": f"cam_{v}", "K": K, "c2w": pose(v).tolist()} for v in range(VIEWS)])
    write_json(folder / "frame.json", [{f"{k:03d}": round(0.03 * k, 6)} for k in range(FRAMES)])
    return folder


CENTRED = [[100.0, 0, WIDTH / 2], [0, 105.0, HEIGHT / 2], [0, 0, 1]]


def springgaus_real(folder: Path) -> Path:
    dynamic = folder / "dynamic"
    calibration, sequence = {}, {"hit_frame": 2}
    for view, name in enumerate(("C0733", "C0787", "C0801")):
        world_to_camera = np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(pose(view))
        rotation, _ = cv2.Rodrigues(world_to_camera[:3, :3])
        calibration[name] = {"rvecs": rotation.tolist(), "tvecs": world_to_camera[:3, 3:].tolist()}
        sequence[name] = [f"{100 * view + k:05d}.jpg" for k in range(FRAMES)]
        for k, file in enumerate(sequence[name]):
            alpha = cover(pixel(view, dot(k), CENTRED))
            draw(dynamic / "videos_images" / name / file, alpha, rgba=False)
            mask = dynamic / "videos_masks" / name / file.replace(".jpg", ".png")
            mask.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(mask), np.round(255 * alpha).astype(np.uint8))
    write_json(dynamic / "cameras_calib.json", {"camera_matrix": K, "distortion_coefficient": [], **calibration})
    write_json(dynamic / "sequences" / "dog" / "0.json", sequence)
    colmap = folder / "static" / "colmap" / "dog" / "cameras.bin"  # pictures 2.5 times as large
    colmap.parent.mkdir(parents=True)
    numbers = 250.0, 262.5, 119.0, 101.0
    colmap.write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 5 * WIDTH // 2, 5 * HEIGHT // 2, *numbers))
    return folder


ANGLE = 0.8
SQUARE = 0.5 * WIDTH / np.tan(ANGLE / 2)
ANGLE_K = [[SQUARE, 0, WIDTH / 2], [0, SQUARE, HEIGHT / 2], [0, 0, 1]]


def blender(folder: Path, *, fps: float = 25.0) -> Path:
    for split, views in (("train", (0, 1)), ("test", (2,))):
        frames = []
        for view in views:
            for k in range(FRAMES):
                draw(folder / split / f"r_{view}_{k}.png", cover(pixel(view, dot(k), ANGLE_K)), rgba=True)
                name = f"./{split}/r_{view}_{k}"
                frames.append({"file_path": name, "time": k / fps, "transform_matrix": pose(view).tolist()})
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
    return folder


def nerfstudio(folder: Path, *, distortion=None, masks="mask_path", fps: float = 25.0) -> Path:
    """Time-major order; masks: "mask_path", "background" (a picture at time −1/fps) or "alpha"."""
    frames = []
    for k in range(-1 if masks == "background" else 0, FRAMES):
        for view in range(VIEWS):
            name = f"images/cam{view}/frame_{k + 1:05d}.png"
            alpha = None if k < 0 else cover(pixel(view, dot(k), K, distortion))
            draw(folder / name, alpha, rgba=masks == "alpha")
            frames.append({"file_path": name, "time": round(k / fps, 6), "transform_matrix": pose(view).tolist()})
            if masks == "mask_path":
                assert alpha is not None
                frames[-1]["mask_path"] = name.replace("images", "masks")
                mask = folder / frames[-1]["mask_path"]
                mask.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(mask), np.round(255 * alpha).astype(np.uint8))
    lens = {"fl_x": FOCAL_X, "fl_y": FOCAL_Y, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, **(distortion or {})}
    model = "OPENCV" if distortion else "PINHOLE"
    write_json(folder / "transforms.json", {"camera_model": model, **lens, "frames": frames})
    return folder
