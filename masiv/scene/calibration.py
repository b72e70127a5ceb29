"""Cameras of a scene as a fit corrected them: before, after, and what was changed; ``calibration.json`` of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.errors import InputError
from masiv.files import write_json
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.strict import read_json, reason

CALIBRATION = "calibration.json"
_SCHEMA = 2


@dataclass(frozen=True)
class CameraCorrection:
    """What is added to a given camera; see ``corrected_camera``.

    rotation (3,) [rad], a rotation vector, and translation (3,) [m]: in camera axes. log_focal: logarithm of the factor
    of the focal length. time_offset [s]: the camera's frame F was taken at F / fps + time_offset.
    """

    rotation: np.ndarray
    translation: np.ndarray
    log_focal: float
    time_offset: float


NO_CORRECTION = CameraCorrection(np.zeros(3), np.zeros(3), 0.0, 0.0)


def corrected_camera(camera: Camera, correction: CameraCorrection, pivot: np.ndarray) -> Camera:
    """``camera`` after ``correction``: x' = R (x - c) + c + translation.

    x are camera coordinates of the given camera, c those of ``pivot`` (3,) [m, world]. The focal length is multiplied
    by exp(log_focal).
    """
    rotation = Rotation.from_rotvec(correction.rotation).as_matrix()
    given = np.asarray(camera.world_to_camera, np.float64)
    centre = given[:3, :3] @ pivot + given[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = rotation @ given[:3, :3]
    pose[:3, 3] = rotation @ (given[:3, 3] - centre) + centre + correction.translation
    intrinsics = np.array(camera.intrinsics, np.float64)
    intrinsics[:2, :2] *= np.exp(correction.log_focal)
    return replace(camera, intrinsics=intrinsics, world_to_camera=pose)


@dataclass(frozen=True)
class Calibration:
    """The cameras of a scene before and after a fit corrected them, by index of the scene.

    given, refined: all cameras; those that no fit saw are the same in both. time_offsets [s] of their clocks.
    displacement_px: root mean square by which the correction moves the object in each picture. standard_errors_px: of
    the correction by silhouettes, if there was one, as such displacements; None for cameras that no fit saw.
    """

    given: tuple[Camera, ...]
    refined: tuple[Camera, ...]
    time_offsets: tuple[float, ...]
    displacement_px: tuple[float, ...]
    standard_errors_px: tuple[float | None, ...] = ()

    @classmethod
    def of(
        cls,
        scene: Scene,
        corrections: Sequence[CameraCorrection],
        pivot: np.ndarray,
        points: np.ndarray,
        *,
        since: Calibration | None = None,
        standard_errors_px: Sequence[float] = (),
    ) -> Calibration:
        """corrections: of ``scene.views``, about ``pivot`` (3,) [m]. points (P, 3) [m]: of the object.

        since: an earlier correction, which ``scene`` has already; the result is of both.
        standard_errors_px: of ``scene.views``; by default those of ``since``.
        """
        given = scene.cameras if since is None else since.given
        by_view = dict(zip(scene.views, corrections, strict=True))
        every = [by_view.get(view, NO_CORRECTION) for view in range(len(scene.cameras))]
        known = scene.time_offsets or (0.0,) * len(scene.cameras)
        refined = tuple(
            corrected_camera(camera, by_view[view], pivot) if view in by_view else camera
            for view, camera in enumerate(scene.cameras)
        )
        moved = [
            after.project(points)[0] - before.project(points)[0] for before, after in zip(given, refined, strict=True)
        ]
        errors = dict(zip(scene.views, standard_errors_px, strict=True)) if standard_errors_px else {}
        return cls(
            given,
            refined,
            tuple(offset + correction.time_offset for offset, correction in zip(known, every, strict=True)),
            tuple(float(np.sqrt((m**2).sum(axis=1).mean())) for m in moved),
            since.standard_errors_px if since else tuple(errors.get(view) for view in range(len(refined))),
        )

    def applied_to(self, scene: Scene) -> Scene:
        """``scene`` with the refined cameras and their clocks; once more changes nothing.

        Raises InputError if its cameras are others than those that were refined.
        """
        for known in (self.given, self.refined):
            if len(known) == len(scene.cameras) and all(map(_same, known, scene.cameras)):
                cameras = tuple(
                    replace(camera, intrinsics=new.intrinsics, world_to_camera=new.world_to_camera)
                    for camera, new in zip(scene.cameras, self.refined, strict=True)
                )
                return replace(scene, cameras=cameras, time_offsets=self.time_offsets)
        raise InputError(
            f"{scene.path}: the cameras are not those that were refined ({len(self.given)} cameras): give the scene of "
            "the run, or reconstruct it anew"
        )

    def summary(self) -> list[dict[str, Any]]:
        """A row for each camera: name, displacement_px, focal_factor, time_offset_s."""
        rows = zip(self.given, self.refined, self.time_offsets, self.displacement_px, strict=True)
        return [
            {
                "name": given.name,
                "displacement_px": displacement,
                "focal_factor": float(refined.intrinsics[0, 0] / given.intrinsics[0, 0]),
                "time_offset_s": offset,
            }
            for given, refined, offset, displacement in rows
        ]

    def text(self) -> str:
        """One sentence: by how much the cameras were corrected."""
        largest = int(np.argmax(self.displacement_px))
        rms = float(np.sqrt(np.mean(np.square(self.displacement_px))))
        return (
            f"cameras refined: {rms:.2f} px on average in their pictures, {self.displacement_px[largest]:.2f} px for "
            f"{self.given[largest].name}; clocks by {1e3 * max(map(abs, self.time_offsets)):.1f} ms at most"
        )

    def save(self, folder: Path) -> None:
        """Write calibration.json into ``folder``."""
        errors = self.standard_errors_px or (None,) * len(self.given)
        rows = zip(self.given, self.refined, self.time_offsets, self.displacement_px, errors, strict=True)
        write_json(Path(folder) / CALIBRATION, {"schema": _SCHEMA, "cameras": [_row(*row) for row in rows]})

    @classmethod
    def load(cls, folder: Path) -> Calibration | None:
        """What ``save`` wrote into ``folder``; None if there is none. Raises InputError if it is broken."""
        path = Path(folder) / CALIBRATION
        if not path.exists():
            return None
        try:
            data = read_json(path)
            if data["schema"] not in (1, _SCHEMA):  # 1 has no standard errors
                raise ValueError(f"schema {data['schema']}")
            rows = data["cameras"]
            return cls(
                tuple(_camera(row, "given") for row in rows),
                tuple(_camera(row, "refined") for row in rows),
                tuple(float(row["time_offset_s"]) for row in rows),
                tuple(float(row["displacement_px"]) for row in rows),
                tuple(None if (e := row.get("standard_error_px")) is None else float(e) for row in rows),
            )
        except (InputError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{path} is not a calibration saved by masiv ({reason(error, path)}): reconstruct anew"
            ) from error


def _same(one: Camera, other: Camera) -> bool:
    """But for the shutter, which scene.yaml says and no fit changes."""
    return (
        (one.name, one.width, one.height) == (other.name, other.width, other.height)
        and np.array_equal(one.intrinsics, other.intrinsics)
        and np.array_equal(one.world_to_camera, other.world_to_camera)
    )


def _row(
    given: Camera, refined: Camera, time_offset: float, displacement: float, standard_error: float | None
) -> dict[str, Any]:
    turn = refined.world_to_camera[:3, :3] @ given.world_to_camera[:3, :3].T
    return {
        "name": given.name,
        "width": given.width,
        "height": given.height,
        "rotation_deg": np.degrees(Rotation.from_matrix(turn).as_rotvec()),
        "centre_shift_m": refined.centre - given.centre,
        "focal_factor": refined.intrinsics[0, 0] / given.intrinsics[0, 0],
        "time_offset_s": time_offset,
        "displacement_px": displacement,
        "standard_error_px": standard_error,
        **{
            name: {"intrinsics": camera.intrinsics, "world_to_camera": camera.world_to_camera}
            for name, camera in (("given", given), ("refined", refined))
        },
    }


def _camera(row: dict[str, Any], which: str) -> Camera:
    intrinsics, pose = (np.array(row[which][key], np.float64) for key in ("intrinsics", "world_to_camera"))
    if (
        intrinsics.shape != (3, 3)
        or pose.shape != (4, 4)
        or not np.isfinite([*intrinsics.ravel(), *pose.ravel()]).all()
    ):
        raise ValueError(f"camera {row['name']}")
    return Camera(str(row["name"]), int(row["width"]), int(row["height"]), intrinsics, pose)
