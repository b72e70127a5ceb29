"""Content hashes: what distinguishes observations, bodies and rollouts. Light: no torch, no taichi."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Scene
from masiv.scene.summary import conventions
from masiv.tracks.tracks import Tracks

DIGITS = 9
"""Significant digits of a number, and decimals [m, s] of an array, that count in ``identity``: how a file was read may
differ by rounding from one platform to another."""


def content_hash(value: Any, digits: int | None = None) -> str:
    """Hexadecimal digest (64 characters) of plain values, arrays, tensors, mappings, sequences and dataclasses.

    digits: rounds numbers, see ``DIGITS``; None: every bit counts. Raises TypeError for a value of another kind.
    """
    digest = hashlib.sha256()
    _update(digest, value, digits)
    return digest.hexdigest()


def _update(digest: Any, value: Any, digits: int | None) -> None:
    if hasattr(value, "detach"):  # a torch tensor
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        if digits is not None and np.issubdtype(value.dtype, np.floating):
            value = np.round(value, digits) + 0.0  # no negative zeros
        digest.update(f"array {value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, (float, np.floating)):
        digest.update(f"number {float(value).hex() if digits is None else f'{value:.{digits}g}'} ".encode())
    elif value is None or isinstance(value, (bool, int, str, bytes, slice, np.generic)):
        digest.update(f"{type(value).__name__} {value!r} ".encode())
    elif is_dataclass(value) and not isinstance(value, type):
        _update(digest, [getattr(value, f.name) for f in fields(value)], digits)  # a field may get another name
    elif isinstance(value, Mapping):
        digest.update(f"mapping {len(value)} ".encode())
        for key in value:
            _update(digest, key, digits)
            _update(digest, value[key], digits)
    elif isinstance(value, Sequence):
        digest.update(f"sequence {len(value)} ".encode())
        for item in value:
            _update(digest, item, digits)
    else:
        raise TypeError(f"a value of type {type(value).__name__} has no content hash")


def identity(source: Scene | Tracks) -> dict[str, Any]:
    """What distinguishes scenes, as plain values: numbers that people can compare, and digests of the rest.

    Of tracks everything counts but the folder: data, geometry, mass, clamp, placement, medium, gravity. Of a video, the
    first and the last picture (with its depth) or point cloud stand for all of them.
    """
    return _tracks_identity(source) if isinstance(source, Tracks) else _scene_identity(source)


def _scene_identity(scene: Scene) -> dict[str, Any]:
    cameras, pictures = hashlib.sha256(), hashlib.sha256()
    for camera in scene.cameras:
        cameras.update(np.round([*camera.intrinsics.ravel(), *camera.world_to_camera.ravel()], 6).tobytes())
    visible = scene.views
    if scene.load_cloud is not None:
        ends = [scene.cloud(frame) for frame in (0, scene.frame_count - 1)]
        return {**conventions(scene), "clouds_sha256": content_hash(ends, DIGITS)[:16]}
    for view, frame in ((visible[0], 0), (visible[-1], scene.frame_count - 1)):
        picture = _picture(scene, view, frame)
        pictures.update(picture.image.tobytes())
        if not scene.masks_estimated:  # those follow from the pictures and from this version of masiv
            pictures.update(picture.mask.tobytes())
        if picture.depth is not None:
            pictures.update(picture.depth.tobytes())
    return {
        **conventions(scene),
        "cameras_sha256": cameras.hexdigest()[:16],
        "pictures_sha256": pictures.hexdigest()[:16],
    }


def _picture(scene: Scene, view: int, frame: int) -> Frame:
    """A picture; without its mask if that would have to be estimated, which takes seconds."""
    if scene.load_with_mask is None:
        return scene.frame(view, frame)
    camera = scene.cameras[view]
    return scene.load_with_mask(view, frame, np.zeros((camera.height, camera.width), np.float32))


def _tracks_identity(tracks: Tracks) -> dict[str, Any]:
    ground = tracks.ground
    return {
        "layout": "tracks",
        "bodies": list(tracks.bodies),
        "runs": [
            f"{run.name}: {run.purpose}, {len(run.times)} frames"
            + (f" from {run.ignore_after_release:g} s" if run.ignore_after_release else "")
            for run in tracks.runs
        ],
        "up": tracks.up.tolist(),
        "gravity_m_s2": tracks.gravity.tolist(),
        "ground": None if ground is None else {"normal": ground.normal.tolist(), "height_m": float(ground.height)},
        "medium_density_kg_m3": float(tracks.medium_density),
        "medium_viscosity_pa_s": float(tracks.medium_viscosity),
        "bodies_sha256": content_hash(list(tracks.bodies.values()), DIGITS)[:16],
        "runs_sha256": content_hash(tracks.runs, DIGITS)[:16],
    }


def source_digest(*packages: str) -> str:
    """Digest of the Python files of ``packages`` of masiv: it changes with the code that computes a result."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
