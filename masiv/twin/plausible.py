"""Whether a twin that was read, or edited by hand, can be of bodies in this world: see ``masiv.bounds``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from masiv.bounds import ACCELERATION, DENSITY, FPS, FRICTION, LENGTH, SPEED, SPIN, VOLUME
from masiv.errors import InputError
from masiv.twin.body import Body, Boundary, InitialCondition

_UNIT = 1e-6
"""By how much the length of a direction may differ from 1."""
_FULLER = 2.0
"""How much more than the box around its particles a body may fill: a coarse lattice has half of its cells outside."""


def check_plausible(where: str, twin: Mapping[str, Any]) -> None:
    """Raises InputError, with the key in the file ``where``, if a field of a ``Twin`` cannot be."""
    boundary: Boundary = twin["boundary"]
    ACCELERATION.check(twin["gravity"], f"{where}: 'gravity'")
    _check_direction(twin["up"], f"{where}: 'up'")
    FRICTION.check(boundary.friction, f"{where}: 'boundary.friction'")
    if boundary.ground is not None:
        _check_direction(boundary.ground.normal, f"{where}: 'boundary.ground.normal'")
        LENGTH.check(abs(boundary.ground.height), f"{where}: 'boundary.ground.height'")
    for k, start in enumerate(twin["initial_conditions"]):
        _check_start(start, f"{where}: 'initial_conditions.{k}")
    placed = {start.body for start in twin["initial_conditions"] if start.placement is not None}
    for k, body in enumerate(twin["bodies"]):
        _check_body(body, boundary, body.name in placed, f"{where}: 'bodies.{k}")


def _check_start(start: InitialCondition, where: str) -> None:
    FPS.check(start.fps, f"{where}.fps'")
    SPEED.check(start.velocity, f"{where}.velocity'")
    SPIN.check(start.omega, f"{where}.omega'")
    if start.placement is not None:
        turn = start.placement.rotation
        LENGTH.check(start.placement.translation, f"{where}.placement.translation'")
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            raise InputError(f"{where}.placement.rotation' is not a rotation (scaled, sheared or mirrored axes)")


def _check_body(body: Body, boundary: Boundary, placed: bool, where: str) -> None:
    VOLUME.check(body.volume, f"{where}.volume'")
    DENSITY.check(body.density, f"{where}.density'")
    if body.particles is None:
        return
    points = body.particles.astype(np.float64)
    cell = (body.volume / len(points)) ** (1 / 3) if body.particle_spacing is None else body.particle_spacing
    box = float((np.ptp(points, axis=0) + cell).prod())
    if body.volume > _FULLER * box:
        raise InputError(
            f"{where}.volume' is {body.volume:.4g} m³, but the box around its particles has {box:.4g} m³: correct it, "
            "or identify again"
        )
    ground = boundary.ground
    if ground is not None and not placed and (points @ ground.normal).max() < ground.height:
        raise InputError(
            f"{where}.particles' are all below the ground at {ground.height:.4g} m ('boundary.ground.height'): lower it"
        )


def _check_direction(vector: np.ndarray, where: str) -> None:
    if abs(float(np.linalg.norm(vector)) - 1) > _UNIT:
        raise InputError(f"{where} is {[float(v) for v in vector]}: it must be a direction of length 1")
