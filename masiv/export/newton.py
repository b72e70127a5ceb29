"""The twin as a scene for another simulator: Newton, with its implicit material point method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.errors import InputError
from masiv.files import atomic_folder, write_json, write_npz

if TYPE_CHECKING:
    from masiv.twin import Twin
    from masiv.twin.body import Body, TwinEffect

NEWTON_VERSION = "1.8"
SCRIPT = Path(__file__).with_name("newton_scene.py")
STICKING = 1e3
"""Coefficient of friction [1] of a ground along which nothing slides."""
REPRESENTED = ("gravity_scale", "body_force", "ground_height")


def write_newton_scene(twin: Twin, folder: str | Path, *, material: Mapping[str, Any] | None = None) -> list[str]:
    """Write ``folder``/scene.py, scene.json and particles.npz: the only body of ``twin`` as it starts in the first
    observation, for the API of Newton 1.8. ``python scene.py`` simulates it.

    Returns sentences about what Newton does not represent; they are comments at the head of scene.py, too. material:
    the content of material.json, for the strength of a law that is not classical. Raises InputError for a rigid body,
    for several bodies and if ``folder`` holds something.
    """
    settings, particles, notes = newton_scene(twin, material)
    head = [f"# For Newton {NEWTON_VERSION}. Differences to the twin:", *(f"# - {note}" for note in notes)]
    with atomic_folder(Path(folder)) as temporary:
        script = "\n".join([*head, "", SCRIPT.read_text(encoding="utf-8")])
        (temporary / "scene.py").write_text(script, encoding="utf-8")
        write_json(temporary / "scene.json", settings)
        write_npz(temporary / "particles.npz", compressed=True, **particles)
    return notes


def newton_scene(
    twin: Twin, material: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray], list[str]]:
    """What scene.json and particles.npz hold, and what is left out. Raises InputError."""
    from masiv.export.newton_material import newton_material
    from masiv.mpm.design import grid_spacing

    if twin.rigid:
        names = ", ".join(body.name for body in twin.bodies)
        raise InputError(f"{names}: a rigid body has no material points, so there is no scene for Newton")
    twin = twin.in_condition()
    body, start = twin.body, twin.initial_conditions[0]
    place = start.placement
    positions = np.asarray(twin.positions if place is None else place.to_world(twin.positions), np.float64)
    arms = positions - positions.mean(axis=0)
    spacing = (body.volume / len(positions)) ** (1 / 3)
    held = _held(body, twin.positions, spacing)
    masses = np.where(held, 0.0, body.density * body.volume / len(positions))
    velocities = np.where(held[:, None], 0.0, start.velocity + np.cross(start.omega, arms))
    values, notes = newton_material(twin.law, None if material is None else material.get("quantities"))
    notes += ["the solver is implicit: contact and damping differ from the twin's, and impacts lose energy"]
    if body.clamps:
        notes.append("a clamp holds particles up to a particle spacing away from it, in place of grid nodes inside")
    if start.release is not None:
        notes.append("the body starts at rest in its undeformed shape: how it was held before its release is left out")
        if start.release.motions:
            notes.append("clamps do not move: the path along which one is carried is left out")
    gravity, shift = _exact_effects(twin)
    notes += [_left_out(effect) for effect in twin.effects if effect.name not in REPRESENTED]
    settings = {
        "newton": NEWTON_VERSION,
        "fps": start.fps,
        "gravity_m_s2": gravity.tolist(),
        "ground": _ground(twin, shift),
        "particle_radius_m": spacing / 2,
        "voxel_size_m": grid_spacing(body.volume, len(positions), twin.simulator),
        "material": values,
        "differences": notes,
    }
    arrays = {"positions": positions, "velocities": velocities, "masses": masses}
    return settings, {name: array.astype(np.float32) for name, array in arrays.items()}, notes


def _held(body: Body, own: np.ndarray, spacing: float) -> np.ndarray:
    """Which particles (Q,) are held: those in a clamp or within a ``spacing`` [m] of it, own axes."""
    held = np.zeros(len(own), bool)
    for clamp in body.clamps:
        held |= replace(clamp, heights=clamp.heights + spacing).holds(own)
    return held


def _ground(twin: Twin, shift: float) -> dict[str, Any] | None:
    if twin.ground is None or twin.contact == "none":
        return None
    return {
        "normal": np.asarray(twin.ground.normal).tolist(),
        "height_m": float(twin.ground.height) + shift,
        "friction": twin.friction if twin.contact == "slip" else STICKING,
    }


def _exact_effects(twin: Twin) -> tuple[np.ndarray, float]:
    """Gravity (3,) [m/s^2, world] and shift of the ground [m] with the effects that these represent exactly."""
    from masiv.scene.transforms import SimulationFrame

    axes = SimulationFrame.from_scene(twin.up, twin.ground)
    gravity, shift = np.asarray(twin.gravity, np.float64), 0.0
    for effect in twin.effects:
        if effect.name == "gravity_scale":
            gravity = gravity + effect.values["relative_change"] * np.asarray(twin.gravity)
        elif effect.name == "body_force":
            force = np.array([effect.values[f"acceleration_{axis}"] for axis in "xyz"])
            gravity = gravity + axes.vectors_to_world(force)
        elif effect.name == "ground_height":
            shift += effect.values["height"]
    return gravity, shift


def _left_out(effect: TwinEffect) -> str:
    values = ", ".join(f"{name} {value:.4g} {unit}".rstrip() for name, value, unit, _ in effect.rows())
    return f"effect {effect.name} ({values}) is left out: Newton has none like it"
