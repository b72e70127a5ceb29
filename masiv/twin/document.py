"""twin.yaml of schema 2, with its laws and particles in files alongside it. Schema 1: ``masiv.twin.schema1``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.bounds import LENGTH
from masiv.errors import InputError
from masiv.files import read_safetensors, write_safetensors, write_yaml
from masiv.scene.scene import Ground
from masiv.strict import read_yaml, reason, validated
from masiv.tracks.placement import Placement
from masiv.tracks.prescribed_motion import PrescribedMotion
from masiv.tracks.tracks import Clamp
from masiv.twin.body import OFFSET_UNITS, Body, Boundary, InitialCondition, Release, TwinEffect
from masiv.twin.document_parts import SCHEMA, BodyPart, Document, EffectPart, InitialConditionPart, LawPart, MotionPart
from masiv.twin.plausible import check_plausible

if TYPE_CHECKING:
    from masiv.materials.law import Law

TWIN_FILE = "twin.yaml"
SAME_LAW = 1e-4
"""Relative difference [1] within which parameters of a law are the same; those of a neural law are computed anew."""


def write_document(twin: Mapping[str, Any], folder: Path, name: str = TWIN_FILE) -> None:
    """Write the fields of a ``Twin`` to ``name`` in ``folder``, each file complete or not at all."""
    suffix = name.removeprefix("twin").removesuffix(".yaml")
    particles_file = f"particles{suffix}.safetensors"
    bodies, tensors = [], {}
    for index, body in enumerate(twin["bodies"]):
        law_file = f"law{suffix}{f'.{index}' if index else ''}.safetensors"
        if body.law is not None:
            body.law.save(folder / law_file)
        if body.particles is not None:
            tensors[body.name] = np.ascontiguousarray(body.particles)
        bodies.append(_body_entry(body, law_file, particles_file))
    if tensors:
        write_safetensors(folder / particles_file, tensors)
    motion_file = f"motion{suffix}.safetensors"
    motions = _motion_tensors(twin["initial_conditions"])
    if motions:
        write_safetensors(folder / motion_file, motions)
    boundary: Boundary = twin["boundary"]
    ground = None
    if boundary.ground is not None:
        ground = {"normal": _floats(boundary.ground.normal), "height": _quantity(boundary.ground.height, "m")}
    document = {
        "schema": SCHEMA,
        "bodies": bodies,
        "initial_conditions": [_initial_condition_entry(start, motion_file) for start in twin["initial_conditions"]],
        "gravity": _quantity(twin["gravity"], "m/s^2"),
        "boundary": {"ground": ground, "contact": boundary.contact, "friction": float(boundary.friction)},
        "up": _floats(twin["up"]),
        "effects": [_effect_entry(effect) for effect in twin["effects"]],
        "simulator": twin["simulator"].model_dump(),
        "fit": twin["fit"],
    }
    write_yaml(folder / name, document)


def _body_entry(body: Body, law_file: str, particles_file: str) -> dict[str, Any]:
    particles, drag = None, None
    if body.particles is not None:
        spacing = None if body.particle_spacing is None else _quantity(body.particle_spacing, "m")
        particles = {"file": particles_file, "tensor": body.name, "spacing": spacing}
    clamps = [
        {
            "normals": [_floats(normal) for normal in clamp.normals],
            "heights": _floats(clamp.heights),
            "markers": list(clamp.markers),
            **({"prescribed": True} if clamp.prescribed else {}),
        }
        for clamp in body.clamps
    ]
    if body.drag is not None:
        drag = {
            "diameter": _quantity(body.drag.diameter, "m"),
            "mass": _quantity(body.drag.mass, "kg"),
            "medium_density": _quantity(body.drag.medium_density, "kg/m^3"),
            "medium_viscosity": _quantity(body.drag.medium_viscosity, "Pa s"),
        }
    return {
        "name": body.name,
        "law": None if body.law is None else {**body.law.description(), "file": law_file},
        "particles": particles,
        "volume": _quantity(body.volume, "m^3"),
        "density": _quantity(body.density, "kg/m^3"),
        "geometry": body.geometry,
        "clamp": (clamps if len(clamps) > 1 else clamps[0]) if clamps else None,
        "drag": drag,
    }


MOTION_TENSORS = ("times", "displacement", "rotation")
"""Of a ``PrescribedMotion``, in the order of its fields but for the centre."""


def _motion_tensors(starts: Sequence[InitialCondition]) -> dict[str, np.ndarray]:
    return {
        f"{_motion_tensor(start, k)}.{name}": np.ascontiguousarray(getattr(motion, name), np.float64)
        for start in starts if start.release is not None
        for k, motion in enumerate(start.release.motions) if motion is not None
        for name in MOTION_TENSORS
    }  # fmt: skip


def _motion_tensor(start: InitialCondition, clamp: int) -> str:
    """Name of the tensors of the motion of one clamp."""
    return f"{start.observation}.{clamp}" if clamp else start.observation


def _initial_condition_entry(start: InitialCondition, motion_file: str) -> dict[str, Any]:
    placement, release = None, None
    if start.placement is not None:
        placement = {
            "rotation": [_floats(row) for row in start.placement.rotation],
            "translation": _quantity(start.placement.translation, "m"),
            "error": _quantity(start.placement.error, "m"),
        }
    if start.release is not None:
        release = {
            "markers": {name: _quantity(place, "m") for name, place in start.release.markers.items()},
            "max_speed": _quantity(start.release.max_speed, "m/s"),
            "offsets": {name: _quantity(value, OFFSET_UNITS[name]) for name, value in start.release.offsets.items()},
        }
        motions = [
            None if motion is None
            else {"file": motion_file, "tensor": _motion_tensor(start, k), "centre": _quantity(motion.centre, "m")}
            for k, motion in enumerate(start.release.motions)
        ]  # fmt: skip
        if motions:
            release["motion"] = motions[0] if len(motions) == 1 else motions
    return {
        "observation": start.observation,
        "body": start.body,
        "condition": start.condition,
        "fps": float(start.fps),
        "velocity": _quantity(start.velocity, "m/s"),
        "omega": _quantity(start.omega, "rad/s"),
        "placement": placement,
        "release": release,
    }


def _effect_entry(effect: TwinEffect) -> dict[str, Any]:
    parameters = {
        name: {"value": float(value), "unit": unit, "stderr": None if stderr is None else float(stderr)}
        for name, value, unit, stderr in effect.rows()
    }
    return {
        "effect": effect.name,
        "bodies": list(effect.bodies),
        "condition": effect.condition,
        "parameters": parameters,
        "place": None if effect.place is None else _quantity(np.array(effect.place), "m"),
    }


def _floats(values: np.ndarray) -> list[float]:
    return [float(v) for v in values]  # YAML knows no numpy scalar


def _quantity(value: float | np.ndarray, unit: str) -> dict[str, Any]:
    return {"value": _floats(np.asarray(value)) if np.ndim(value) else float(value), "unit": unit}


# ---- reading --------------------------------------------------------------------------------------------------------


def read_document(
    folder: Path, name: str = TWIN_FILE, scene: Callable[[], Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """The fields of the ``Twin`` in ``name`` in ``folder``; scene: see ``Twin.load``. Raises InputError."""
    path = folder / name
    if not path.exists():
        raise InputError(f"{folder} holds no {name}: run masiv identify")
    twin = _fields(path, scene)
    check_plausible(str(path), twin)
    return twin


def _fields(path: Path, scene: Callable[[], Mapping[str, Any]] | None) -> dict[str, Any]:
    data = read_yaml(path)
    if data.get("schema") == 1:
        from masiv.twin.schema1 import read_schema1

        return read_schema1(data, path, scene)
    if data.get("schema") != SCHEMA:
        raise InputError(f"{path} has schema {data.get('schema')}, this masiv reads 1 and {SCHEMA}: identify again")
    document = validated(Document, data, str(path))
    bodies = tuple(_body(part, f"{path}: 'bodies.{k}", path.parent) for k, part in enumerate(document.bodies))
    starts = tuple(_initial_condition(part, path.parent) for part in document.initial_conditions)
    effects = tuple(read_effect(part, f"{path}: 'effects.{k}") for k, part in enumerate(document.effects))
    check_names(path, bodies, starts, effects)
    ground = document.boundary.ground
    if ground is not None:
        ground = Ground(np.array(ground.normal), ground.height.value)
    return {
        "bodies": bodies,
        "boundary": Boundary(ground, document.boundary.contact, document.boundary.friction),
        "gravity": np.array(document.gravity.value),
        "up": np.array(document.up),
        "initial_conditions": starts,
        "simulator": document.simulator,
        "effects": effects,
        "fit": document.fit,
    }


def _body(part: BodyPart, where: str, folder: Path) -> Body:
    from masiv.effects.per_body import DragBody
    from masiv.materials.load import load_law

    law = None
    if part.law is not None:
        law = load_law(folder / part.law.file)
        _check_law(part.law, law, f"{where}.law")
    particles, spacing = None, None
    if part.particles is not None:
        particles = read_particles(folder / part.particles.file, part.particles.tensor)
        spacing = None if part.particles.spacing is None else part.particles.spacing.value
    if law is not None and particles is None:
        raise InputError(f"{where}.particles' is missing: a body that deforms consists of particles")
    clamps = []
    for held in part.clamp:
        if len(held.normals) != len(held.heights):
            raise InputError(f"{where}.clamp' needs one height for each normal")
        normals = np.array(held.normals).reshape(-1, 3)
        clamps.append(Clamp(normals, np.array(held.heights), tuple(held.markers), held.prescribed))
    drag = None
    if part.drag is not None:
        d = part.drag
        drag = DragBody(d.diameter.value, d.mass.value, d.medium_density.value, d.medium_viscosity.value)
    return Body(
        part.name, part.volume.value, part.density.value, law, particles, spacing, tuple(clamps), part.geometry, drag
    )  # fmt: skip


def _check_law(part: LawPart, law: Law, where: str) -> None:
    """Raises InputError if the document says something else than the law's file, as after an edit of one of them."""
    if law.kind != part.kind:
        raise InputError(f"{where}.kind' is {part.kind!r}, but {part.file} holds a {law.kind} law")
    for name, row in law.description()["parameters"].items():
        told = part.parameters.get(name)
        value = told.get("value") if isinstance(told, dict) else None
        if not isinstance(value, (int, float)) or not math.isclose(value, row["value"], rel_tol=SAME_LAW):
            held = f"{part.file} holds {row['value']:g}"
            raise InputError(f"{where}.parameters.{name}.value' is {value}, but {held}: identify again")


def read_particles(path: Path, tensor: str) -> np.ndarray:
    """(Q, 3) [m]. Raises InputError if ``path`` does not hold finite positions under the name ``tensor``."""
    try:
        particles = read_safetensors(path)[0][tensor]
    except (InputError, KeyError) as error:
        raise InputError(
            f"{path} does not hold the particles of body '{tensor}' ({reason(error, path)}): identify again"
        ) from error
    if particles.ndim != 2 or particles.shape[1] != 3 or not len(particles) or particles.dtype.kind != "f":
        raise InputError(f"{path}: '{tensor}' of shape {particles.shape} must be positions (Q, 3) [m]")
    LENGTH.check(float(np.abs(particles).max()), f"{path}: '{tensor}'")
    return particles


def _motion(part: MotionPart, folder: Path) -> PrescribedMotion:
    """Raises InputError if its file does not hold a motion."""
    path = folder / part.file
    try:
        tensors = read_safetensors(path)[0]
        times, displacement, rotation = (tensors[f"{part.tensor}.{name}"] for name in MOTION_TENSORS)
    except (InputError, KeyError) as error:
        raise InputError(
            f"{path} does not hold the motion of the clamp in {part.tensor} ({reason(error, path)}): identify again"
        ) from error
    count = len(times)
    if count < 2 or displacement.shape != (count, 3) or rotation.shape != (count, 3) or (np.diff(times) <= 0).any():
        raise InputError(f"{path}: the motion of the clamp in {part.tensor} is not one of ascending times (K,)")
    return PrescribedMotion(times, np.array(part.centre.value), displacement, rotation)


def _initial_condition(part: InitialConditionPart, folder: Path) -> InitialCondition:
    placement, release = None, None
    if part.placement is not None:
        p = part.placement
        placement = Placement(np.array(p.rotation), np.array(p.translation.value), p.error.value)
    if part.release is not None:
        offsets = {name: offset.value for name, offset in part.release.offsets if offset is not None}
        markers = {name: np.array(place.value) for name, place in part.release.markers.items()}
        motions = tuple(None if motion is None else _motion(motion, folder) for motion in part.release.motion)
        release = Release(markers, part.release.max_speed.value, offsets, motions)
    return InitialCondition(
        part.observation, part.body, part.fps, np.array(part.velocity.value), np.array(part.omega.value),
        part.condition, placement, release,
    )  # fmt: skip


def read_effect(part: EffectPart, where: str) -> TwinEffect:
    """Raises InputError for an effect or a parameter that the library does not have, and for a value out of bounds."""
    place = None
    if part.place is not None:
        x, y, z = part.place.value
        place = x, y, z
    values = {name: float(row.value) for name, row in part.parameters.items()}
    stderr = {name: None if row.stderr is None else float(row.stderr) for name, row in part.parameters.items()}
    effect = TwinEffect(part.effect, values, stderr, tuple(part.bodies), part.condition, place)
    try:
        known = {p.name: p for p in effect.parameters}
    except InputError as error:
        raise InputError(f"{where}.effect' is {part.effect!r}: {error}") from error
    for name, row in part.parameters.items():
        key = f"{where}.parameters.{name}"
        if name not in known:
            raise InputError(f"{key}' is unknown: {part.effect} has the parameters {', '.join(known)}")
        p = known[name]
        if row.unit != p.unit:
            raise InputError(f"{key}.unit' is {row.unit!r}: it must be {p.unit}")
        if not p.lower <= row.value <= p.upper:
            raise InputError(f"{key}.value' is {row.value}: it must lie between {p.lower:g} and {p.upper:g} {p.unit}")
    for name, p in known.items():
        if name not in values:
            raise InputError(f"{where}.parameters.{name}' is missing: give it a value [{p.unit}]")
    return effect


def check_names(
    path: Path, bodies: tuple[Body, ...], starts: tuple[InitialCondition, ...], effects: tuple[TwinEffect, ...]
) -> None:
    """Raises InputError if a name is given twice, or stands for no body."""
    names = [body.name for body in bodies]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: 'bodies' has two bodies of one name: {', '.join(names)}")
    observed = [(start.observation, start.body) for start in starts]
    for k, start in enumerate(starts):
        if start.body not in names:
            raise InputError(f"{path}: 'initial_conditions.{k}.body' is {start.body!r}: bodies are {', '.join(names)}")
        if observed.index((start.observation, start.body)) < k:
            raise InputError(f"{path}: 'initial_conditions.{k}' is a second one of {start.observation}: keep one")
    for k, effect in enumerate(effects):
        if unknown := [name for name in effect.bodies if name not in names]:
            raise InputError(f"{path}: 'effects.{k}.bodies' has {unknown[0]!r}: bodies are {', '.join(names)}")
        if any(effect.overlaps(other) for other in effects[:k]):
            raise InputError(f"{path}: 'effects.{k}.effect': {effect.name} is there twice, keep one of them")
