"""The ``scene.yaml`` of a scene of tracks. Light: no torch, no taichi."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator

from masiv.bounds import DENSITY, MASS, SIZE, VISCOSITY, Density, Fps
from masiv.scene.declaration import GroundDeclaration, SceneDeclaration, Vector

Unit = Literal["m", "cm", "mm"]
METRES: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
Side = Annotated[FiniteFloat, Field(gt=0, le=SIZE.upper / METRES["mm"])]
"""Of a body, in the unit of the geometry, which is a millimetre at least."""
Axis = Literal["x", "y", "z"]
Frame = Annotated[int, Field(ge=0, lt=2**31)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CylinderDeclaration(_Part):
    """Its axis is z, its middle the origin."""

    diameter: Side
    length: Side


class HalfSpaceDeclaration(_Part):
    """Everything at normal·x ≤ height."""

    normal: Vector
    height: FiniteFloat


class ClampDeclaration(_Part):
    """The clamped region: ``half_space`` or ``box`` (two opposite corners), in the axes and units of the geometry.

    ``markers``: those fixed to the clamp, which do not move with the material. ``prescribed_motion``: the clamp is
    carried, and moves as its markers do: one or two show its displacement, three that are not on a line its rotation,
    too. The body is at rest in it before the release.
    """

    half_space: HalfSpaceDeclaration | None = None
    box: tuple[Vector, Vector] | None = None
    markers: tuple[str, ...] = ()
    prescribed_motion: bool = False

    @model_validator(mode="after")
    def _one_region(self) -> ClampDeclaration:
        if (self.half_space is None) == (self.box is None):
            raise ValueError("give one of half_space and box")
        if self.prescribed_motion and not self.markers:
            raise ValueError("prescribed_motion needs markers on the clamp: name them in markers")
        return self


class GeometryDeclaration(_Part):
    """The shape of a body at rest and its placement in the world.

    Shape: one of ``mesh`` (a watertight STL, OBJ or PLY, relative to the scene), ``box`` (three sides), ``sphere``
    (diameter) and ``cylinder``. The origin of a primitive is its centre. ``units`` are those of the mesh file, of the
    clamp, and of all numbers here except ``position``.

    Placement: ``markers_at``, positions of markers on the body (one: the body is translated; three or more: the best
    rigid motion to their rest positions); or ``position`` [m] of its origin. ``rotation_deg`` [°] about the fixed axes
    x, then y, then z.
    """

    units: Unit
    mesh: Path | None = None
    box: tuple[Side, Side, Side] | None = None
    sphere: Side | None = None
    cylinder: CylinderDeclaration | None = None
    markers_at: dict[str, Vector] | None = None
    position: Vector | None = None
    rotation_deg: Vector | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> GeometryDeclaration:
        if sum(shape is not None for shape in (self.mesh, self.box, self.sphere, self.cylinder)) != 1:
            raise ValueError("give one of mesh, box, sphere and cylinder")
        if self.markers_at is not None:
            if self.position is not None:
                raise ValueError("markers_at and position say the same thing: give one of them")
            if len(self.markers_at) in (0, 2):
                raise ValueError("markers_at takes one marker, or three and more")
            if len(self.markers_at) > 2 and self.rotation_deg is not None:
                raise ValueError("rotation_deg follows from three markers: leave it out")
        return self


class BodyDeclaration(_Part):
    """One object.

    ``density`` [kg/m³] or ``mass`` [kg]. ``clamp``: what is held, one region or a list of several. ``group``: bodies of
    a group share the effects of their environment, for example drag; by default a body is its own group.
    """

    geometry: GeometryDeclaration | None = None
    density: Density | None = None
    mass: Annotated[float, MASS.field()] | None = None
    poissons_ratio: Annotated[FiniteFloat, Field(gt=-1, lt=0.5)] | None = None
    group: str | None = None
    clamp: tuple[ClampDeclaration, ...] = ()

    @field_validator("clamp", mode="before")
    @classmethod
    def _one_or_several(cls, value: object) -> object:
        if value is None:
            return ()
        return [value] if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _consistent(self) -> BodyDeclaration:
        if self.density is not None and self.mass is not None:
            raise ValueError("give density or mass, not both")
        if self.clamp and self.geometry is None:
            raise ValueError("a clamp needs a geometry")
        return self


class ColumnsDeclaration(_Part):
    """Names of a CSV's columns. ``markers``: marker -> axis -> column, without the axes that were not measured."""

    time: str | None = None
    markers: dict[str, dict[Axis, str]]

    @field_validator("markers")
    @classmethod
    def _some(cls, value: dict[str, dict[Axis, str]]) -> dict[str, dict[Axis, str]]:
        if not value or not all(value.values()):
            raise ValueError("name one marker or more, each with one axis or more")
        return value


class RunDeclaration(_Part):
    """One recording.

    ``file``: CSV, C3D, TRC or TSV, relative to the scene. ``select``: only the rows whose columns have these values.
    ``markers``: only these; or a new name -> name in the file. ``time`` [s]: first and last time that is used.
    ``use``: `fit` for training; `hold_out` for validation, which takes part in the choice of effects; `test` for runs
    that nothing sees before their errors are reported. ``condition``: runs with the same name have the same
    treatment of the body, for example a load or a wind.
    ``rest_frames`` [first, last): frames in which the body is held at rest. ``release_time`` [s, as in the file]: by
    default it is estimated. ``ignore_after_release`` [s]: the run is not compared with the model for this
    long, because the model does not contain what releases the body (a hand that follows, a slack thread). Then the
    initial height and an effective initial state are fitted too. Its earlier name is ``unsteady``. ``held_straight``:
    false if a clamped body is not held in its rest shape before the release; then the deflection of its free end is
    fitted too.
    """

    file: Path
    name: str | None = None
    body: str | None = None
    use: Literal["fit", "hold_out", "test"] = "fit"
    condition: str = ""
    select: dict[str, str | int | float] = {}
    markers: Annotated[tuple[str, ...] | dict[str, str], Field(min_length=1)] | None = None
    rest_frames: tuple[Frame, Frame] | None = None
    release_time: FiniteFloat | None = None
    ignore_after_release: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    held_straight: bool = True
    time: tuple[FiniteFloat, FiniteFloat] | None = None

    @model_validator(mode="before")
    @classmethod
    def _earlier_name(cls, values: object) -> object:
        if isinstance(values, dict) and "unsteady" in values:
            if "ignore_after_release" in values:
                raise ValueError("unsteady is the earlier name of ignore_after_release: give one of them")
            return {"ignore_after_release" if key == "unsteady" else key: value for key, value in values.items()}
        return values

    @field_validator("markers")
    @classmethod
    def _each_once(cls, value: tuple[str, ...] | dict[str, str] | None) -> tuple[str, ...] | dict[str, str] | None:
        own = list(value.values() if isinstance(value, dict) else value or ())
        if len(set(own)) < len(own):
            raise ValueError("a marker is named twice: name each once")
        return value

    @model_validator(mode="after")
    def _ordered(self) -> RunDeclaration:
        for name in ("rest_frames", "time"):
            pair = getattr(self, name)
            if pair is not None and not pair[0] < pair[1]:
                raise ValueError(f"{name}: the second must be greater than the first")
        return self


class TracksDeclaration(_Part):
    """Keys of the ``scene.yaml`` of tracks, with ``layout: tracks``.

    units: of positions, if the files do not give them (a CSV gives them by names of columns such as tip_x_mm). rate
    [Hz]: if the files have no times. up_axis (default z), gravity (default 9.8 m/s² along −up), ground (default none):
    as for video. medium_density [kg/m³], medium_viscosity [Pa s]: of the surrounding medium, by default air at 20 °C.
    """

    layout: Literal["tracks"]
    units: Unit | None = None
    rate: Fps | None = None
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | Vector | None = None
    gravity: FiniteFloat | Vector | None = None
    ground: Literal["none"] | GroundDeclaration | None = None
    medium_density: Annotated[float, Field(gt=0, le=DENSITY.upper)] = 1.2
    medium_viscosity: Annotated[float, Field(gt=0, le=VISCOSITY.upper)] = 1.8e-5
    columns: ColumnsDeclaration | None = None
    bodies: dict[str, BodyDeclaration] = Field(min_length=1)
    runs: tuple[RunDeclaration, ...] = Field(min_length=1)

    @field_validator("up_axis", mode="before")
    @classmethod
    def _plus_sign(cls, value: object) -> object:
        return value.strip().lstrip("+") if isinstance(value, str) else value

    def environment(self) -> SceneDeclaration:
        """Up axis, gravity and ground, with the functions that evaluate them."""
        return SceneDeclaration(up_axis=self.up_axis, gravity=self.gravity, ground=self.ground)
