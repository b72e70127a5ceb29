"""The parts of a digital twin. World frame, SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from masiv.errors import InputError
from masiv.scene.scene import Ground
from masiv.tracks.placement import Placement
from masiv.tracks.prescribed_motion import PrescribedMotion
from masiv.tracks.tracks import Clamp

if TYPE_CHECKING:
    from masiv.effects.context import EffectParameter
    from masiv.effects.per_body import DragBody
    from masiv.materials.law import Law


@dataclass(frozen=True)
class Body:
    """One body. volume [m^3]; density [kg/m^3]; law: None for a rigid body.

    particles (Q, 3) [m] at rest, in world axes, or in the body's own axes if its initial conditions have a placement
    (None: a rigid body is a point mass). particle_spacing [m]: with which they were filled in, if it is not
    (volume / Q)^(1/3). clamps: what is held, own axes. geometry: kind of the solid that was declared. drag: the body as
    the medium sees it.
    """

    name: str
    volume: float
    density: float
    law: Law | None = None
    particles: np.ndarray | None = None
    particle_spacing: float | None = None
    clamps: tuple[Clamp, ...] = ()
    geometry: str | None = None
    drag: DragBody | None = None

    def __post_init__(self) -> None:
        if self.particles is not None:
            check_shape(f"particles of body {self.name}", self.particles, (None, 3))

    @property
    def rigid(self) -> bool:
        return self.law is None


@dataclass(frozen=True)
class Boundary:
    """What surrounds all bodies. ground: the effective plane (None: no ground); contact, friction: see
    ``masiv.mpm.simulator.Simulator``."""

    ground: Ground | None = None
    contact: str = "none"
    friction: float = 0.0


OFFSET_UNITS = {
    "release": "s",
    "lateral_offset_1": "m",
    "lateral_offset_2": "m",
    "vertical_offset": "m",
    "tip_deflection": "m",
}
"""How much later a body is let go than its markers show, how far from its rest it is held along two horizontal axes and
the vertical one, and how far its tip is deflected, see ``masiv.models.clamped_body``."""


@dataclass(frozen=True)
class Release:
    """The start of a body that is held at rest and then let go.

    markers: rest position (3,) [m] of each marker that moves with the material. max_speed [m/s]: the greatest that was
    observed, from which the substep follows. offsets: what was fitted of the start, see ``OFFSET_UNITS``. motions: of
    each clamp of the body, None for one that is fixed; empty if none is carried.
    """

    markers: dict[str, np.ndarray]
    max_speed: float
    offsets: dict[str, float] = field(default_factory=dict)
    motions: tuple[PrescribedMotion | None, ...] = ()


@dataclass(frozen=True)
class InitialCondition:
    """How a body starts in one observation.

    velocity (3,) [m/s] of the centroid; omega (3,) [rad/s] about it; fps: frames a second of the observation;
    condition: under which it was made, which says what effects act. placement: the body's own axes -> world (None: they
    are the same); of a rigid body, its place. release: None for a body that flies freely.
    """

    observation: str
    body: str
    fps: float
    velocity: np.ndarray
    omega: np.ndarray
    condition: str = ""
    placement: Placement | None = None
    release: Release | None = None

    def __post_init__(self) -> None:
        check_shape(f"velocity in {self.observation}", self.velocity, (3,))
        check_shape(f"omega in {self.observation}", self.omega, (3,))


@dataclass(frozen=True)
class TwinEffect:
    """An effect of ``masiv.effects.catalogue`` by name, with ``values`` of all its parameters and their ``stderr``
    (None: not known). The parameters are those for one body, or those that bodies of different size and mass can share.

    bodies: names of those it acts on (none: all). condition: of the observations in which it acts (None: all).
    Vectors and places are in the simulation frame of the body: +y up, the ground at y = 0. place (3,) [m]: the same
    place in the body's own axes, if those are known.
    """

    name: str
    values: dict[str, float]
    stderr: dict[str, float | None] = field(default_factory=dict)
    bodies: tuple[str, ...] = ()
    condition: str | None = None
    place: tuple[float, float, float] | None = None

    @property
    def shared(self) -> bool:
        """Whether ``values`` are those that bodies of different size and mass can share."""
        from masiv.effects.catalogue import effect_named

        per_body = effect_named(self.name).per_body
        return per_body is not None and set(self.values) == {p.name for p in per_body.parameters}

    @property
    def parameters(self) -> tuple[EffectParameter, ...]:
        """Definitions of ``values``, in the order of the library. Raises InputError for an unknown effect."""
        from masiv.effects.catalogue import effect_named

        effect = effect_named(self.name)
        return effect.per_body.parameters if self.shared and effect.per_body else effect.parameters

    def rows(self) -> list[tuple[str, float, str, float | None]]:
        """(parameter, value, unit, standard error) in the order of the library. Raises InputError."""
        return [(p.name, self.values[p.name], p.unit, self.stderr.get(p.name)) for p in self.parameters]

    def acts_on(self, body: str) -> bool:
        return not self.bodies or body in self.bodies

    def overlaps(self, other: TwinEffect) -> bool:
        """Whether both are the same effect and can act on one body in one observation."""
        bodies = not self.bodies or not other.bodies or bool(set(self.bodies) & set(other.bodies))
        return self.name == other.name and bodies and (None in (self.condition, other.condition)
                                                       or self.condition == other.condition)  # fmt: skip


def check_shape(name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raises InputError if ``array`` does not have this shape (None: any length)."""
    if len(np.shape(array)) != len(shape) or any(
        n not in (None, m) for n, m in zip(shape, np.shape(array), strict=True)
    ):
        expected = ", ".join("Q" if n is None else str(n) for n in shape)
        raise InputError(f"{name} has shape {np.shape(array)}, it must be ({expected}{',' * (len(shape) == 1)})")


def with_start_values(start: InitialCondition, values: Mapping[str, float]) -> InitialCondition:
    """``start`` of a point mass or of a body with markers with those of ``values`` that are named ``what@observation``
    for it: ``position_x`` [m] and ``velocity_x`` [m/s] (y, z alike), or the offsets of a release."""
    suffix = f"@{start.observation}"
    own = {name.removesuffix(suffix): float(v) for name, v in values.items() if name.endswith(suffix)}
    if not own:
        return start
    if start.release is not None:
        return replace(start, release=replace(start.release, offsets=own))
    place = start.placement or Placement(np.eye(3), np.zeros(3))
    at = [own.get(f"position_{axis}", place.translation[k]) for k, axis in enumerate("xyz")]
    velocity = [own.get(f"velocity_{axis}", start.velocity[k]) for k, axis in enumerate("xyz")]
    return replace(start, placement=replace(place, translation=np.array(at)), velocity=np.array(velocity))
