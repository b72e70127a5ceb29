"""``calibration.toml`` as Anipose (aniposelib) and Pose2Sim write it, with OpenCV's numbers.

One table a camera: ``name``, ``size`` [width, height], ``matrix`` (3, 3), ``distortions``, ``rotation`` (Rodrigues
vector) and ``translation`` of world to camera, ``fisheye``; a table ``metadata`` is ignored. OpenCV puts pixel centres
at whole numbers.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.files import require_file
from masiv.footage.calibrated_camera import FISHEYE, RATIONAL, CalibratedCamera
from masiv.scene.lens import COEFFICIENTS, HALF
from masiv.scene.listing import array, mapping, text
from masiv.scene.transforms import rotation_vector_to_world_to_camera
from masiv.strict import UNREADABLE, shortened

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def read_toml(path: Path) -> list[CalibratedCamera]:
    """The cameras. Raises InputError for a file that is not TOML, has none, or has one that cannot be used."""
    try:
        content = tomllib.loads(require_file(path).read_text(encoding="utf-8"))
    except UNREADABLE as error:  # includes TOMLDecodeError and UnicodeDecodeError
        raise InputError(f"{path} is not valid TOML: {shortened(error)}") from error
    rows = {key: value for key, value in content.items() if isinstance(value, dict) and "matrix" in value}
    if not rows:
        raise InputError(f"{path} has no camera: each needs a table with name, size, matrix, distortions, rotation, …")
    return [_camera(row, key, f"{path}, [{key}]") for key, row in rows.items()]


def _camera(row: dict[str, Any], key: str, where: str) -> CalibratedCamera:
    row = dict(mapping(row, where))
    name = text(row, "name", where) if "name" in row else key
    width, height = (int(v) for v in array(row, "size", ((2,),), where))
    if min(width, height) < 1:
        raise InputError(f"{where}: 'size' must be [width, height] in pixels")
    matrix = array(row, "matrix", ((3, 3),), where)
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise InputError(
            f"{where}: 'matrix' has a skew of {matrix[0, 1]:g}, no camera of today has one: calibrate again"
        )
    matrix[0, 1] = 0.0
    fisheye = bool(row.get("fisheye", False))
    lengths = (len(FISHEYE),) if fisheye else (1, 2, 4, len(COEFFICIENTS), len(RATIONAL))
    coefficients = array(row, "distortions", tuple((n,) for n in lengths), where)
    if not fisheye:
        size = len(COEFFICIENTS) if len(coefficients) <= len(COEFFICIENTS) else len(RATIONAL)
        coefficients = np.pad(coefficients, (0, size - len(coefficients)))
    pose = rotation_vector_to_world_to_camera(
        array(row, "rotation", ((3,),), where), array(row, "translation", ((3,), (3, 1)), where)
    )
    return CalibratedCamera(name, width, height, matrix + HALF, pose, coefficients, fisheye)
