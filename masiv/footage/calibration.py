"""Read a calibration, whatever its format, and find the camera that a recording was made with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from masiv.errors import InputError
from masiv.footage.calibrated_camera import FISHEYE, RATIONAL, CalibratedCamera
from masiv.footage.toml_calibration import read_toml
from masiv.scene.colmap import ColmapCamera, read_cameras, read_images
from masiv.scene.lens import COEFFICIENTS, read_lens
from masiv.scene.listing import array, entries, mapping, number, text
from masiv.scene.transforms import opengl_c2w_to_world_to_camera
from masiv.strict import read_json

SAME_POSE = 1e-6
"""Largest difference of two poses [1, unit of length] of one camera that rounding explains."""


def read_calibration(path: Path) -> list[CalibratedCamera]:
    """The cameras in ``path``: a folder with COLMAP's ``cameras`` and ``images`` (also in sparse/0), a nerfstudio
    ``transforms.json``, or a ``.toml`` as Anipose and Pose2Sim write it.

    Raises InputError for another file, and for one that cannot be used.
    """
    if path.is_dir():
        for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
            for suffix in (".bin", ".txt"):
                if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
                    return _read_colmap(folder, suffix)
        if (path / "transforms.json").is_file():
            return _read_transforms(path / "transforms.json")
        raise InputError(
            f"--calibration {path} has neither COLMAP's cameras and images (.bin or .txt) nor a transforms.json: give "
            "the folder of the sparse model"
        )
    if path.name.startswith(("cameras.", "images.")) and path.suffix in (".bin", ".txt"):
        return read_calibration(path.parent)
    readers: dict[str, Callable[[Path], list[CalibratedCamera]]] = {".json": _read_transforms, ".toml": read_toml}
    if path.suffix not in readers:
        raise InputError(
            f"--calibration {path}: give a COLMAP folder, a transforms.json, or a .toml of OpenCV, Anipose or Pose2Sim"
        )
    return readers[path.suffix](path)


def camera_of(cameras: Sequence[CalibratedCamera], name: str, where: Path) -> CalibratedCamera:
    """The one of ``cameras`` that is called ``name``, as its picture, without suffix, or as a folder of its picture.

    Raises InputError if there is none, or if the pictures that match have different poses.
    """
    for called in (_is, _is_stem, _is_folder):
        found = [camera for camera in cameras if called(camera.name, name)]
        if found:
            break
    else:
        listed = ", ".join(camera.name for camera in cameras[:12]) + (", …" if len(cameras) > 12 else "")
        raise InputError(
            f"{where} has no camera {name!r} (it has {listed}): name the recordings as the calibration does, or give "
            "--camera NAME=RECORDING"
        )
    apart = max(np.abs(found[0].world_to_camera - other.world_to_camera).max() for other in found)
    if apart > SAME_POSE:
        raise InputError(
            f"{where} has {len(found)} pictures of {name!r} with different poses ({found[0].name}, {found[1].name}): a "
            "camera stands still, so calibrate with one picture a camera, or name one with --camera NAME=RECORDING"
        )
    return replace(found[0], name=name)


def _is(camera: str, name: str) -> bool:
    return camera == name


def _is_stem(camera: str, name: str) -> bool:
    return PurePosixPath(camera).stem == name


def _is_folder(camera: str, name: str) -> bool:
    return name in PurePosixPath(camera).parts[:-1]


def _read_colmap(folder: Path, suffix: str) -> list[CalibratedCamera]:
    lenses = read_cameras(folder / f"cameras{suffix}")
    cameras = []
    for image in read_images(folder / f"images{suffix}"):
        if image.camera not in lenses:
            raise InputError(f"{folder}: images{suffix} names camera {image.camera}, which cameras{suffix} lacks")
        cameras.append(_of_colmap(image.name, lenses[image.camera], image.world_to_camera))
    return cameras


def _of_colmap(name: str, lens: ColmapCamera, pose: np.ndarray) -> CalibratedCamera:
    fisheye = "FISHEYE" in lens.model
    names = FISHEYE if fisheye else RATIONAL if lens.model == "FULL_OPENCV" else COEFFICIENTS
    intrinsics = np.array([[lens.focal_x, 0, lens.cx], [0, lens.focal_y, lens.cy], [0, 0, 1.0]])
    coefficients = np.array([lens.coefficients.get(key, 0.0) for key in names])
    return CalibratedCamera(name, lens.width, lens.height, intrinsics, pose, coefficients, fisheye)


def _read_transforms(path: Path) -> list[CalibratedCamera]:
    """The poses of a nerfstudio listing; its times and pictures are not used."""
    content = mapping(read_json(path), str(path))
    common = {key: value for key, value in content.items() if key != "frames"}
    cameras = []
    for k, given in enumerate(entries(content.get("frames"), f"{path}: 'frames'", "picture")):
        where = f"{path}, frame {k}"
        row = {**common, **mapping(given, where)}
        name = text(row, "file_path", where)
        width, height = (round(number(row, key, where)) for key in ("w", "h"))
        if min(width, height) < 1:
            raise InputError(f"{where}: w × h is {width}×{height}, it must be the size of the pictures in pixels")
        fisheye = row.get("camera_model") == "OPENCV_FISHEYE" or bool(row.get("is_fisheye"))
        bare = {key: value for key, value in row.items() if key not in (*RATIONAL, "camera_model", "is_fisheye")}
        lens = read_lens(bare if fisheye else row, width, height, where)
        coefficients = np.array([number(row, key, where, 0.0) for key in FISHEYE]) if fisheye else lens.coefficients
        try:
            pose = opengl_c2w_to_world_to_camera(array(row, "transform_matrix", ((4, 4), (3, 4)), where))
        except InputError as error:
            raise InputError(str(error) if where in str(error) else f"{where}: {error}") from error
        cameras.append(CalibratedCamera(name, width, height, lens.intrinsics, pose, coefficients, fisheye))
    return cameras
