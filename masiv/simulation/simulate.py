"""Simulate a twin, as it was observed or in another situation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from masiv import runtime
from masiv.bounds import ACCELERATION, SPEED, SPIN
from masiv.errors import InputError
from masiv.progress import Progress, silent
from masiv.simulation.flight import simulate_flight
from masiv.simulation.force import ForcePulse
from masiv.simulation.free_body import simulate_free_body
from masiv.simulation.release import simulate_release
from masiv.simulation.rollout import Rollout
from masiv.simulation.variation import without_effects
from masiv.strict import quoted
from masiv.twin import Twin

MAX_FRAMES = 10**6
"""Eleven hours at 24 frames a second; the motion of a thousand particles then takes 12 GB."""


def simulate(
    twin: Twin,
    *,
    frames: int,
    fps: float | None = None,
    velocity: np.ndarray | None = None,
    omega: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    force: ForcePulse | None = None,
    without: tuple[str, ...] = (),
    condition: str | None = None,
    substeps: int | None = None,
    fields: bool = False,
    progress: Progress = silent,
) -> Rollout:
    """The first ``frames`` frames of the twin's motion at ``fps`` (None: that of the observation), frame 0 included.

    velocity (3,) [m/s], omega (3,) [rad/s] and gravity (3,) [m/s^2], world frame, replace what was identified.
    force: acts for a while. without: names of effects that are left out. condition: of the observations whose start and
    effects are simulated (None: the first). substeps: in a frame (None: as many as the speed asks for). fields: also
    stress, strain and accelerations by effects, see ``masiv.simulation.particle_fields``.

    Particles of a body that flies freely are subdivided (``simulator.subparticles``). Of several observations of one
    body the first is simulated. Raises InputError for a value that is not finite, for an effect or
    a condition that the twin does not have, for a force that starts after the last frame and for what this kind of body
    cannot have; NonFiniteError if the motion diverges.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"--frames {quoted(frames)}: give 1 to {MAX_FRAMES}")
    if substeps is not None and substeps < 1:
        raise InputError(f"substeps {substeps}: give at least 1")
    given = (("velocity", velocity, SPEED), ("omega", omega, SPIN), ("gravity", gravity, ACCELERATION))
    for name, value, bound in given:
        if value is not None:
            if np.shape(value) != (3,) or not np.isfinite(value).all():
                raise InputError(f"--{name} takes three finite numbers X,Y,Z")
            bound.check(value, f"--{name}")
    twin = without_effects(twin, without).in_condition(condition)
    rate = twin.fps if fps is None else fps
    if force is not None and force.start >= (frames - 1) / rate:
        raise InputError(f"--force-from {force.start:g}: the last frame is at {(frames - 1) / rate:.3g} s")
    if gravity is not None:
        twin = replace(twin, gravity=np.asarray(gravity, dtype=np.float64))
    motion = {"velocity": velocity, "omega": omega}
    with runtime.torch_threads(1):
        if twin.rigid:
            _refuse("a rigid body is a point", omega=omega, force=force, substeps=substeps)
            return simulate_flight(twin, frames=frames, fps=rate, velocity=velocity, fields=fields)
        if twin.initial_conditions[0].release is not None:
            _refuse("the body is let go from rest", **motion, force=force, substeps=substeps)
            return simulate_release(twin, frames=frames, fps=rate, fields=fields, progress=progress)
        if force is not None:
            acceleration = np.asarray(force.force) / (twin.density * twin.volume)
            ACCELERATION.check(acceleration, f"--force, on {twin.density * twin.volume:.3g} kg")
        twin = twin.with_motion(**{n: np.asarray(v, dtype=np.float64) for n, v in motion.items() if v is not None})
        return simulate_free_body(
            twin, frames=frames, fps=rate, force=force, substeps=substeps, fields=fields, progress=progress
        )


def _refuse(why: str, **given: Any) -> None:
    for name, value in given.items():
        if value is not None:
            raise InputError(f"--{name}: {why}, leave it out")
