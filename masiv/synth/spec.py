"""What a synthetic scene is made of. Light: no torch, no taichi."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from masiv.bounds import ACCELERATION, FRICTION, LENGTH, SIZE, SPEED, SPIN, Density, Fps
from masiv.errors import InputError
from masiv.shapes import ShapeSpec
from masiv.strict import read_yaml, validated

Vector = tuple[float, float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class MaterialSpec(_Part):
    """A classical law of masiv.materials with its parameters, in SI units (angles in degrees)."""

    law: str = "neo_hookean"
    parameters: dict[str, float] = {"youngs_modulus": 4e4, "poissons_ratio": 0.3}
    density: Density = Field(1000.0, description="[kg/m^3]")


class CameraSpec(_Part):
    """Cameras evenly around the body, at alternating heights."""

    count: int = Field(11, ge=2, le=200)
    size: int = Field(128, ge=16, le=2048, description="side of the square pictures [pixels]")
    distance: float = Field(2.4, gt=0, le=LENGTH.upper, description="to the vertical axis through the target [m]")
    heights: tuple[float, ...] = Field((0.5, 1.1, 1.9), min_length=1, description="taken in turn [m]")
    target: Vector = Field((0, 0.3, 0), description="all cameras look at it [m]")
    field_of_view_deg: float = Field(36.0, gt=1, lt=150)


class SynthSpec(_Part):
    """A synthetic multi-view scene: y up, ground at y = 0."""

    shape: ShapeSpec = ShapeSpec.model_validate({})
    material: MaterialSpec = MaterialSpec.model_validate({})
    velocity: Vector = Field((0, 0, 0), description="of the centre at frame 0 [m/s]")
    omega: Vector = Field((0, 0, 0), description="spin at frame 0 [rad/s]")
    gravity: Vector = Field((0, -9.8, 0), description="[m/s^2]")
    contact: Literal["sticky", "release", "slip"] = "sticky"
    friction: float = Field(0.0, ge=0, le=FRICTION.upper, description="Coulomb's coefficient of contact slip")
    effects: dict[str, dict[str, float]] = Field(
        {}, description="of masiv.effects, by name, with their parameters: simulated, but declared only in truth.yaml"
    )
    frames: int = Field(12, ge=2, le=10**5)
    fps: Fps = 24.0
    cameras: CameraSpec = CameraSpec.model_validate({})
    texture: Literal["noise", "stripes", "patches"] = "noise"
    texture_contrast: float = Field(
        1.0,
        ge=0,
        le=1,
        description="of the texture's colors about their mean; 0: a plain body, whose spin does not show",
    )
    image_noise: float = Field(1.5, ge=0, description="standard deviation, of 255")
    jpeg_quality: int | None = Field(None, ge=1, le=100, description="pictures are compressed; none: they are not")
    supersampling: Annotated[int, Field(ge=1, le=8)] = 3
    particles: int = Field(20000, ge=100, le=10**7, description="in the simulation")
    truth_particles: int = Field(4096, ge=1, description="of them in gt/")
    seed: int = Field(0, ge=0)


def read_spec(path: Path) -> SynthSpec:
    """The spec in a YAML file. Raises InputError, with the nearest known key, if something is wrong with it."""
    spec = validated(SynthSpec, read_yaml(path), str(path))
    _check(spec, str(path))
    mesh = spec.shape.mesh
    if mesh is None:
        return spec
    located = mesh if mesh.is_absolute() else path.parent / mesh
    if not located.is_file():
        raise InputError(f"{path}: shape.mesh {located} does not exist or is not a regular file")
    return spec.model_copy(update={"shape": spec.shape.model_copy(update={"mesh": located})})


def _check(spec: SynthSpec, where: str) -> None:
    """Raises InputError for what no body does, and for cameras that do not look at the body from outside."""
    SIZE.check(spec.shape.size, f"{where}: shape.size")
    SPEED.check(math.hypot(*spec.velocity), f"{where}: velocity")
    SPIN.check(math.hypot(*spec.omega), f"{where}: omega")
    ACCELERATION.check(math.hypot(*spec.gravity), f"{where}: gravity")
    reach = max(math.hypot(*spec.shape.position), spec.shape.clearance, *map(abs, spec.cameras.target))
    LENGTH.check(max(reach, *map(abs, spec.cameras.heights)), f"{where}: a place of the body or the cameras")
    if spec.cameras.distance < spec.shape.size / 2:
        raise InputError(
            f"{where}: cameras.distance is {spec.cameras.distance:g} m, inside of the body of {spec.shape.size:g} m: "
            "move the cameras away"
        )
