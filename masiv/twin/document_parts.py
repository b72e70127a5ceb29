"""What twin.yaml of schema 2 holds: its parts, typed."""

from __future__ import annotations

from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from masiv.mpm.config import SimulatorConfig

SCHEMA = 2

Unit = TypeVar("Unit")
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Entry = TypeVar("Entry")


def _one_or_several(value: object) -> object:
    if value is None:
        return []
    return [value] if isinstance(value, dict) else value


Several = Annotated[list[Entry], BeforeValidator(_one_or_several)]
"""A list, a single entry of it, or null for an empty one."""
FileName = Annotated[str, Field(pattern=r"^[^/\\]+$")]


class Part(BaseModel):
    """A mapping in the file: no other keys, no NaN, no text for a number."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Scalar(Part, Generic[Unit]):
    value: float
    unit: Unit


class Positive(Part, Generic[Unit]):
    value: Annotated[float, Field(gt=0)]
    unit: Unit


class Vector3(Part, Generic[Unit]):
    value: Vector
    unit: Unit


class ParameterPart(Part):
    value: float
    unit: str
    stderr: Annotated[float, Field(ge=0)] | None = None


class EffectPart(Part):
    effect: str
    bodies: list[str] = []
    condition: str | None = None
    parameters: dict[str, ParameterPart]
    place: Vector3[Literal["m"]] | None = None


class LawPart(BaseModel):
    """The law itself is in ``file``; kind and parameters repeat it for people, and may not differ from it."""

    model_config = ConfigDict(extra="allow", strict=True)

    kind: str
    file: FileName
    parameters: dict[str, Any]


class ParticlesPart(Part):
    file: FileName
    tensor: str
    spacing: Positive[Literal["m"]] | None = None


class ClampPart(Part):
    normals: list[Vector]
    heights: list[float]
    markers: list[str]
    prescribed: bool = False


class DragPart(Part):
    diameter: Positive[Literal["m"]]
    mass: Positive[Literal["kg"]]
    medium_density: Scalar[Literal["kg/m^3"]]
    medium_viscosity: Scalar[Literal["Pa s"]]


class BodyPart(Part):
    name: str
    law: LawPart | None
    particles: ParticlesPart | None
    volume: Positive[Literal["m^3"]]
    density: Positive[Literal["kg/m^3"]]
    geometry: str | None = None
    clamp: Several[ClampPart] = []
    drag: DragPart | None = None


class GroundPart(Part):
    normal: Vector
    height: Scalar[Literal["m"]]


class BoundaryPart(Part):
    ground: GroundPart | None
    contact: Literal["sticky", "release", "slip", "none"]
    friction: Annotated[float, Field(ge=0)]


class PlacementPart(Part):
    rotation: Annotated[list[Vector], Field(min_length=3, max_length=3)]
    translation: Vector3[Literal["m"]]
    error: Scalar[Literal["m"]]


class OffsetsPart(Part):
    """Those of ``OFFSET_UNITS``."""

    release: Scalar[Literal["s"]] | None = None
    lateral_offset_1: Scalar[Literal["m"]] | None = None
    lateral_offset_2: Scalar[Literal["m"]] | None = None
    vertical_offset: Scalar[Literal["m"]] | None = None
    tip_deflection: Scalar[Literal["m"]] | None = None


class MotionPart(Part):
    """A ``PrescribedMotion``; its times, displacement and rotation are tensors of ``file``, after ``tensor``."""

    file: FileName
    tensor: str
    centre: Vector3[Literal["m"]]


class ReleasePart(Part):
    markers: dict[str, Vector3[Literal["m"]]]
    max_speed: Scalar[Literal["m/s"]]
    offsets: OffsetsPart
    motion: Several[MotionPart | None] = []


class InitialConditionPart(Part):
    observation: str
    body: str
    condition: str = ""
    fps: Annotated[float, Field(gt=0)]
    velocity: Vector3[Literal["m/s"]]
    omega: Vector3[Literal["rad/s"]]
    placement: PlacementPart | None = None
    release: ReleasePart | None = None


class Document(Part):
    """twin.yaml. Lists have one entry for each body, each observation and each effect."""

    schema_: Annotated[Literal[2], Field(alias="schema")]
    bodies: Annotated[list[BodyPart], Field(min_length=1)]
    initial_conditions: Annotated[list[InitialConditionPart], Field(min_length=1)]
    gravity: Vector3[Literal["m/s^2"]]
    boundary: BoundaryPart
    up: Vector
    effects: list[EffectPart]
    simulator: SimulatorConfig
    fit: dict[str, Any]


# ---- writing --------------------------------------------------------------------------------------------------------
