"""The ``scene.yaml`` next to the data of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from masiv.bounds import ACCELERATION, LENGTH, Density, Fps
from masiv.errors import InputError
from masiv.scene.camera import Camera
from masiv.scene.depth import DepthNoise
from masiv.scene.scene import Ground
from masiv.scene.shutter import Shutter
from masiv.strict import read_yaml, validated

Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Box = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class GroundDeclaration(BaseModel):
    """A plane {x : normal·x = height}; ``height`` [m] along the normalized ``normal``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    normal: Vector
    height: FiniteFloat = 0.0


class DepthNoiseDeclaration(BaseModel):
    """See ``masiv.scene.depth.DepthNoise``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    constant: Annotated[FiniteFloat, Field(gt=0)] = DepthNoise().constant
    quadratic: Annotated[FiniteFloat, Field(ge=0)] = DepthNoise().quadratic

    def noise(self) -> DepthNoise:
        """As the readers and stages take it."""
        return DepthNoise(self.constant, self.quadratic)


class MasksDeclaration(BaseModel):
    """Masks by a video segmenter, for pictures that have none; see ``masiv.scene.segmenter``.

    weights: the folder of the model, relative to scene.yaml. boxes: around the object in the first picture of a camera,
    (x0, y0, x1, y1) [pixels]; needed for cameras without a picture of the empty scene.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    segmenter: Literal["sam2"]
    weights: Annotated[str, Field(min_length=1)]
    boxes: dict[str, Box] = Field(default_factory=dict)

    def boxes_by_view(self, cameras: Sequence[Camera]) -> dict[int, Box]:
        """``boxes`` by index of the camera. Raises InputError for an unknown camera and a box outside its picture."""
        views = {camera.name: view for view, camera in enumerate(cameras)}
        for name, (x0, y0, x1, y1) in self.boxes.items():
            if name not in views:
                raise InputError(f"scene.yaml: masks.boxes names camera {name!r}, the cameras are {', '.join(views)}")
            camera = cameras[views[name]]
            if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
                raise InputError(
                    f"scene.yaml: masks.boxes.{name} must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1 in the picture "
                    f"of {camera.width}×{camera.height} pixels"
                )
        return {views[name]: box for name, box in self.boxes.items()}


class SceneDeclaration(BaseModel):
    """Keys of ``scene.yaml``. A missing key has the default of the layout.

    fps: frames per second. up_axis: x, y, z, with a minus sign, or three numbers. gravity: three numbers [m/s²], or one
    magnitude along −up. ground: `none` or {normal, height}. density [kg/m³]. crop_box: two opposite corners [m, world];
    masks are cut to it. fit_frames: number of training frames, unless --fit-frames is given. exposure_time [s]: of a
    row. readout_time [s]: of a rolling shutter, from the top row to the last one; negative if the last row is read
    first. Both are one number, or a mapping from names of cameras; those that are not in it have 0. depth_unit [m]: of
    the steps of depth pictures. depth_noise: standard deviation of a depth z, constant [m] + quadratic [1/m] z². masks:
    a video segmenter for pictures without masks.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    fps: Fps | None = None
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | Vector | None = None
    gravity: FiniteFloat | Vector | None = None
    ground: Literal["none"] | GroundDeclaration | None = None
    density: Density | None = None
    crop_box: tuple[Vector, Vector] | None = None
    fit_frames: Annotated[int, Field(ge=2)] | None = None
    exposure_time: NotNegative | dict[str, NotNegative] = 0.0
    readout_time: FiniteFloat | dict[str, FiniteFloat] = 0.0
    depth_unit: Annotated[FiniteFloat, Field(gt=0)] | None = None
    depth_noise: DepthNoiseDeclaration | None = None
    masks: MasksDeclaration | None = None

    @field_validator("up_axis", mode="before")
    @classmethod
    def _plus_sign(cls, value: object) -> object:
        return value.strip().lstrip("+") if isinstance(value, str) else value

    def up(self, default: str) -> np.ndarray:
        """Unit vector, shape (3,)."""
        value = default if self.up_axis is None else self.up_axis
        if isinstance(value, str):
            sign = -1.0 if value.startswith("-") else 1.0
            return sign * np.array(AXES[value.lstrip("-")]) + 0.0  # + 0.0 turns −0 into 0
        return _unit(value, "up_axis")

    def gravity_vector(self, up: np.ndarray, default: float) -> np.ndarray:
        """Shape (3,) [m/s²]. ``default`` is the magnitude along −up."""
        value = default if self.gravity is None else self.gravity
        ACCELERATION.check(np.atleast_1d(value), "scene.yaml: gravity")
        if isinstance(value, tuple):
            return np.array(value)
        return -abs(value) * up + 0.0  # + 0.0 turns −0 into 0

    def ground_plane(self, up: np.ndarray, default_height: float | None) -> Ground | None:
        """The declared ground, or the plane across ``up`` at ``default_height`` [m]. InputError if it faces down."""
        if self.ground == "none":
            return None
        if isinstance(self.ground, GroundDeclaration):
            LENGTH.check(abs(self.ground.height), "scene.yaml: ground.height")
            ground = Ground(_unit(self.ground.normal, "ground.normal"), self.ground.height)
            if ground.normal @ up <= 0:
                raise InputError("scene.yaml: ground.normal points away from up_axis: turn one of them round")
            return ground
        return None if default_height is None else Ground(up, default_height)

    def crop_corners(self) -> np.ndarray | None:
        """The eight corners of the crop box, shape (8, 3) [m], or None."""
        if self.crop_box is None:
            return None
        low, high = np.minimum(*self.crop_box), np.maximum(*self.crop_box)
        if (high - low).min() <= 0:
            raise InputError("scene.yaml: crop_box is flat: give two opposite corners")
        choice = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=bool)
        return np.where(choice, high, low)

    def shutters(self, cameras: Sequence[Camera], fps: float) -> tuple[Shutter, ...]:
        """The shutter of each camera.

        Raises InputError for a camera that does not exist and for a time that is longer than a frame.
        """
        names = [camera.name for camera in cameras]
        for key, times in (("exposure_time", self.exposure_time), ("readout_time", self.readout_time)):
            for name, time in times.items() if isinstance(times, dict) else [(None, times)]:
                if name is not None and name not in names:
                    raise InputError(f"scene.yaml: {key} names camera {name!r}, the cameras are {', '.join(names)}")
                if abs(time) > 1 / fps * (1 + 1e-6):
                    raise InputError(f"scene.yaml: {key} is {time:g} s, a frame has {1 / fps:.6g} s: give seconds")

        def of(times: float | dict[str, float], name: str) -> float:
            return times.get(name, 0.0) if isinstance(times, dict) else times

        return tuple(
            Shutter.of_image(of(self.exposure_time, c.name), of(self.readout_time, c.name), c.height) for c in cameras
        )


def read_declaration(folder: Path) -> SceneDeclaration:
    """The scene.yaml in ``folder``, or an empty declaration. Raises InputError for an unknown key or a bad value."""
    path = folder / "scene.yaml"
    return validated(SceneDeclaration, read_yaml(path), str(path)) if path.exists() else SceneDeclaration()


def _unit(vector: tuple[float, float, float], name: str) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise InputError(f"scene.yaml: {name} is zero, it must be a direction")
    return np.array(vector) / length
