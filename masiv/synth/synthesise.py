"""Write a synthetic scene in PAC-NeRF's layout, with its ground truth."""

from __future__ import annotations

import functools
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import yaml

from masiv.errors import InputError
from masiv.progress import Progress, silent
from masiv.scene.camera import Camera
from masiv.shapes import make_body
from masiv.synth.motion import Skin, simulate
from masiv.synth.picture import Surface, background, enlarged_camera, picture
from masiv.synth.spec import CameraSpec, SynthSpec
from masiv.synth.texture import solid_color

_SMALL = [cv2.IMWRITE_PNG_COMPRESSION, 9]


def synthesise(spec: SynthSpec, out: Path, *, progress: Progress = silent) -> None:
    """Simulate and film ``spec`` into the new folder ``out``, complete or not at all. Needs ``masiv.runtime.start``.

    The spec with its undeclared effects is in ``truth.yaml``, and nowhere else in ``out``. Raises InputError if ``out``
    is not empty, or for an unusable mesh, law or effect.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds something already: give --out a new folder")
    draft = out.with_name(out.name + ".tmp")
    if draft.exists():
        shutil.rmtree(draft)
    try:
        (draft / "data").mkdir(parents=True)
        (draft / "gt").mkdir()
        _write_scene(spec, draft, progress)
        if out.exists():
            out.rmdir()
        os.replace(draft, out)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        if isinstance(error, OSError):
            error.filename = str(out)  # not the temporary name, or none at all
        raise


def _write_scene(spec: SynthSpec, draft: Path, progress: Progress) -> None:
    progress("simulate", 0, 1)
    body = make_body(spec.shape, spec.particles)
    motion = simulate(spec, body)
    progress("simulate", 1, 1)
    kept = np.random.default_rng([spec.seed, 3]).permutation(len(body.particles))[: spec.truth_particles]
    for frame in range(spec.frames):
        np.save(draft / "gt" / f"particles_{frame}.npy", motion[frame, np.sort(kept)])
    cameras = ring(spec.cameras)
    skin = Skin(body.vertices, body.particles)
    empty = [background(enlarged_camera(camera, spec.supersampling), spec.seed) for camera in cameras]
    color = functools.partial(solid_color, spec.texture, seed=spec.seed, contrast=spec.texture_contrast)
    listing = []
    for done, frame in enumerate(range(-1, spec.frames)):
        surface = None
        if frame >= 0:
            surface = Surface(skin.at(motion[frame].astype(np.float64)), body.faces, body.local)
        for view, camera in enumerate(cameras):
            image, share = picture(camera, empty[view], surface, color, spec.supersampling)
            noise = np.random.default_rng([spec.seed, 4, view, frame + 1]).normal(0, spec.image_noise, image.shape)
            image = _compressed(np.rint(np.clip(255 * image + noise, 0, 254)).astype(np.uint8), spec.jpeg_quality)
            _write(draft / "data" / f"r_{view}_{frame}.png", image)
            if frame >= 0:
                _write(draft / "data" / f"m_{view}_{frame}.png", np.where(share[..., None] >= 0.5, image, 255))
            listing.append(_entry(camera, view, frame, spec.fps))
        progress("render", done + 1, spec.frames + 1)
    (draft / "all_data.json").write_text(json.dumps(listing, indent=1) + "\n", encoding="utf-8")
    truth = {
        **spec.model_dump(mode="json"),
        "volume_m3": float(body.volume),
        "simulated_particles": len(body.particles),
    }
    (draft / "truth.yaml").write_text(yaml.safe_dump(truth, sort_keys=False), encoding="utf-8")


def _compressed(image: np.ndarray, quality: int | None) -> np.ndarray:
    """``image`` (H, W, 3) as a JPEG of that quality shows it; no pixel is white, which masks mean."""
    if quality is None:
        return image
    encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.minimum(decoded[..., ::-1], 254)


def ring(spec: CameraSpec) -> tuple[Camera, ...]:
    """Cameras evenly round the target, all looking at it."""
    focal = spec.size / 2 / np.tan(np.radians(spec.field_of_view_deg) / 2)
    intrinsics = np.array([[focal, 0, spec.size / 2], [0, focal, spec.size / 2], [0, 0, 1.0]])
    target = np.asarray(spec.target, float)
    cameras = []
    for k in range(spec.count):
        angle = 2 * np.pi * k / spec.count
        height = spec.heights[k % len(spec.heights)]
        centre = np.array(
            [target[0] + spec.distance * np.sin(angle), height, target[2] + spec.distance * np.cos(angle)]
        )
        forward = (target - centre) / np.linalg.norm(target - centre)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        cameras.append(Camera(str(k), spec.size, spec.size, intrinsics, pose))
    return tuple(cameras)


def _entry(camera: Camera, view: int, frame: int, fps: float) -> dict:
    """A line of all_data.json: the pose is camera to world, in OpenGL axes."""
    to_world = np.concatenate([camera.world_to_camera[:3, :3].T * [1, -1, -1], camera.centre[:, None]], axis=1)
    return {
        "file_path": f"./data/r_{view}_{frame}.png",
        "c2w": to_world.tolist(),
        "intrinsic": camera.intrinsics.tolist(),
        "time": frame / fps,
    }


def _write(path: Path, rgb: np.ndarray) -> None:
    written, data = cv2.imencode(".png", np.ascontiguousarray(rgb.astype(np.uint8)[..., ::-1]), _SMALL)
    assert written
    path.write_bytes(data.tobytes())  # which says why it cannot be written
