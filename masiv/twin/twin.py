"""The digital twin: everything that is needed to simulate the observed bodies again. World frame, SI units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.errors import InputError
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground
from masiv.twin.body import Body, Boundary, InitialCondition, TwinEffect, check_shape
from masiv.twin.document import TWIN_FILE, read_document, write_document

if TYPE_CHECKING:
    from masiv.materials.law import Law

VOLUME_ERROR = "volume_standard_error_m3"
"""Key of ``Twin.fit``: standard error of the volume of a filmed body."""


@dataclass(frozen=True)
class Twin:
    """Bodies, their surroundings and how they start. World frame, SI units.

    gravity (3,) [m/s^2]; up (3,); initial_conditions: one or more for each body, those of the first condition first;
    effects: what acts besides laws, gravity and boundary; fit: how the laws were found (numbers, units in the names).
    The properties of a single filmed body (``law``, ``velocity``…) raise InputError if there are several bodies.
    """

    bodies: tuple[Body, ...]
    boundary: Boundary
    gravity: np.ndarray
    up: np.ndarray
    initial_conditions: tuple[InitialCondition, ...]
    simulator: SimulatorConfig
    effects: tuple[TwinEffect, ...] = ()
    fit: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape("gravity", self.gravity, (3,))
        check_shape("up", self.up, (3,))

    @classmethod
    def of_body(
        cls,
        *,
        positions: np.ndarray,
        velocity: np.ndarray,
        omega: np.ndarray,
        gravity: np.ndarray,
        ground: Ground | None,
        contact: str,
        volume: float,
        density: float,
        up: np.ndarray,
        fps: float,
        law: Law,
        simulator: SimulatorConfig,
        friction: float = 0.0,
        fit: dict[str, Any] | None = None,
        effects: tuple[TwinEffect, ...] = (),
        name: str = "body",
        observation: str = "observation",
    ) -> Twin:
        """The twin of one deformable body that flies freely. positions (Q, 3) [m, world] at frame 0."""
        body = Body(name, float(volume), float(density), law, np.asarray(positions, dtype=np.float32))
        start = InitialCondition(observation, name, float(fps), np.asarray(velocity), np.asarray(omega))
        boundary = Boundary(ground, contact, friction)
        return cls((body,), boundary, np.asarray(gravity), np.asarray(up), (start,), simulator, effects, fit or {})

    # -- the single body ------------------------------------------------------------------------------------------

    @property
    def body(self) -> Body:
        """The only body. Raises InputError if there are several."""
        if len(self.bodies) != 1:
            names = ", ".join(body.name for body in self.bodies)
            raise InputError(f"the twin has {len(self.bodies)} bodies: {names}; this needs a twin of one")
        return self.bodies[0]

    @property
    def positions(self) -> np.ndarray:
        """Particles (Q, 3) [m] of the only body. Raises InputError if it has none."""
        if self.body.particles is None:
            raise InputError(f"body {self.body.name} of the twin is rigid: it has no particles")
        return self.body.particles

    @property
    def law(self) -> Law:
        """Of the only body. Raises InputError if it is rigid."""
        if self.body.law is None:
            raise InputError(f"body {self.body.name} of the twin is rigid: it has no law")
        return self.body.law

    @property
    def volume(self) -> float:
        return self.body.volume

    @property
    def density(self) -> float:
        return self.body.density

    @property
    def ground(self) -> Ground | None:
        return self.boundary.ground

    @property
    def contact(self) -> str:
        return self.boundary.contact

    @property
    def friction(self) -> float:
        return self.boundary.friction

    @property
    def velocity(self) -> np.ndarray:
        """(3,) [m/s] in the first observation."""
        return self.initial_conditions[0].velocity

    @property
    def omega(self) -> np.ndarray:
        """(3,) [rad/s] in the first observation."""
        return self.initial_conditions[0].omega

    @property
    def fps(self) -> float:
        """Frames a second of the first observation."""
        return self.initial_conditions[0].fps

    @property
    def rigid(self) -> bool:
        """Whether no body deforms."""
        return all(body.rigid for body in self.bodies)

    # -- choices --------------------------------------------------------------------------------------------------

    @property
    def conditions(self) -> tuple[str, ...]:
        """Those of the initial conditions; in the first one the laws were fitted."""
        return tuple(dict.fromkeys(start.condition for start in self.initial_conditions))

    def in_condition(self, condition: str | None = None) -> Twin:
        """With the initial conditions of ``condition`` (None: the first) and the effects that act there. Raises
        InputError for an unknown one."""
        condition = self.conditions[0] if condition is None else condition
        if condition not in self.conditions:
            known = ", ".join(repr(c) for c in self.conditions)
            raise InputError(f"the twin has no initial condition under '{condition}': its conditions are {known}")
        starts = tuple(start for start in self.initial_conditions if start.condition == condition)
        acting = tuple(effect for effect in self.effects if effect.condition in (None, condition))
        return replace(self, initial_conditions=starts, effects=acting)

    def without_condition(self, condition: str) -> Twin:
        """Without the effects that act under ``condition`` alone."""
        return replace(self, effects=tuple(effect for effect in self.effects if effect.condition != condition))

    def with_body(self, **changes: Any) -> Twin:
        """The only body with other fields, see ``Body``."""
        return replace(self, bodies=(replace(self.body, **changes),))

    def with_boundary(self, **changes: Any) -> Twin:
        """See ``Boundary``."""
        return replace(self, boundary=replace(self.boundary, **changes))

    def with_motion(self, **changes: Any) -> Twin:
        """The first initial condition with other fields, see ``InitialCondition``."""
        first, *others = self.initial_conditions
        return replace(self, initial_conditions=(replace(first, **changes), *others))

    # -- files ----------------------------------------------------------------------------------------------------

    def save(self, folder: str | Path, name: str = TWIN_FILE) -> None:
        """Write ``name``, laws and particles, each file complete or not at all. Those of twin.before.yaml have
        ``.before`` in their names, too."""
        write_document(vars(self), Path(folder), name)

    @classmethod
    def load(cls, folder: str | Path, name: str = TWIN_FILE, *, scene: Callable[[], Twin] | None = None) -> Twin:
        """Read what ``save`` wrote, of schema 1 too. scene: gives the twin without effects that the scene of a run of
        tracks describes (``masiv.twin.from_tracks``), since files of schema 1 do not hold its bodies.

        Raises InputError, with the key, if the file is missing or holds something else.
        """
        return cls(**read_document(Path(folder), name, None if scene is None else lambda: vars(scene())))
