"""The digital twin: everything that is needed to simulate the object again."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from safetensors.numpy import load_file

from masiv.errors import InputError
from masiv.files import write_safetensors, write_yaml
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground

if TYPE_CHECKING:
    from masiv.materials.law import Law

SCHEMA = 1


@dataclass(frozen=True)
class TwinEffect:
    """An effect of ``masiv.effects.catalogue`` by name, with ``values`` of all its parameters and their ``stderr``
    (None: not known). Vectors and places are in the simulation frame of the twin: +y up, its ``ground`` at y = 0."""

    name: str
    values: dict[str, float]
    stderr: dict[str, float | None] = field(default_factory=dict)

    def rows(self) -> list[tuple[str, float, str, float | None]]:
        """(parameter, value, unit, standard error) in the order of the library. Raises InputError."""
        from masiv.effects.catalogue import effect_named

        return [
            (p.name, self.values[p.name], p.unit, self.stderr.get(p.name)) for p in effect_named(self.name).parameters
        ]


@dataclass(frozen=True)
class Twin:
    """Geometry, initial motion, law and surroundings of one object. World frame, SI units.

    positions (Q, 3) float32 [m] at frame 0; velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] about it;
    gravity (3,) [m/s^2]; ground: the effective plane (None: no ground); contact, friction: see
    ``masiv.mpm.simulator.Simulator``; volume [m^3]; density [kg/m^3]; up (3,); fps: of the video it came from. fit: how
    the law was found (numbers with units). effects: what acts besides.
    """

    positions: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    gravity: np.ndarray
    ground: Ground | None
    contact: str
    friction: float
    volume: float
    density: float
    up: np.ndarray
    fps: float
    law: Law
    simulator: SimulatorConfig
    fit: dict[str, Any] = field(default_factory=dict)
    effects: tuple[TwinEffect, ...] = ()

    def save(self, folder: Path) -> None:
        """Write twin.yaml, law.safetensors and particles.safetensors, each complete or not at all."""
        self.law.save(folder / "law.safetensors")
        positions = torch.from_numpy(np.ascontiguousarray(self.positions, dtype=np.float32))
        write_safetensors(folder / "particles.safetensors", {"positions": positions})
        ground = None
        if self.ground is not None:
            ground = {"normal": _floats(self.ground.normal), "height": _quantity(self.ground.height, "m")}
        document = {
            "schema": SCHEMA,
            "law": {**self.law.description(), "file": "law.safetensors"},
            "initial": {
                "particles": "particles.safetensors",
                "velocity": _quantity(_floats(self.velocity), "m/s"),
                "omega": _quantity(_floats(self.omega), "rad/s"),
            },
            "gravity": _quantity(_floats(self.gravity), "m/s^2"),
            "boundary": {"ground": ground, "contact": self.contact, "friction": float(self.friction)},
            "body": {"volume": _quantity(self.volume, "m^3"), "density": _quantity(self.density, "kg/m^3")},
            "up": _floats(self.up),
            "fps": float(self.fps),
            "effects": [_effect_entry(effect) for effect in self.effects],
            "simulator": self.simulator.model_dump(),
            "fit": self.fit,
        }
        write_yaml(folder / "twin.yaml", document)

    @classmethod
    def load(cls, folder: Path, name: str = "twin.yaml") -> Twin:
        """Read what ``save`` wrote, from ``name`` in ``folder``. Raises InputError where it is missing or is something
        else, and for an effect or a parameter that the library does not have."""
        from masiv.materials.load import load_law

        path = folder / name
        try:
            document = yaml.safe_load(path.read_text(encoding="utf-8"))
            if document["schema"] != SCHEMA:
                raise InputError(f"{path} has schema {document['schema']}, this masiv reads {SCHEMA}: identify again")
            boundary, initial = document["boundary"], document["initial"]
            ground = boundary["ground"]
            if ground is not None:
                ground = Ground(np.array(ground["normal"]), ground["height"]["value"])
            return cls(
                positions=load_file(folder / initial["particles"])["positions"],
                velocity=np.array(initial["velocity"]["value"]),
                omega=np.array(initial["omega"]["value"]),
                gravity=np.array(document["gravity"]["value"]),
                ground=ground,
                contact=boundary["contact"],
                friction=boundary["friction"],
                volume=document["body"]["volume"]["value"],
                density=document["body"]["density"]["value"],
                up=np.array(document["up"]),
                fps=document["fps"],
                law=load_law(folder / document["law"]["file"]),
                simulator=SimulatorConfig(**document["simulator"]),
                fit=document["fit"],
                effects=_read_effects(document["effects"], path),
            )
        except (OSError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise InputError(f"{folder} holds no twin that can be read ({error}): run masiv identify") from error


def _floats(values: np.ndarray) -> list[float]:
    return [float(v) for v in values]


def _quantity(value: float | list[float], unit: str) -> dict[str, Any]:
    return {"value": value if isinstance(value, list) else float(value), "unit": unit}  # YAML knows no numpy scalar


def _effect_entry(effect: TwinEffect) -> dict[str, Any]:
    parameters = {
        name: {"value": float(value), "unit": unit, "stderr": None if stderr is None else float(stderr)}
        for name, value, unit, stderr in effect.rows()
    }
    return {"effect": effect.name, "parameters": parameters}


def _read_effects(entries: Any, path: Path) -> tuple[TwinEffect, ...]:
    """The list ``effects`` of twin.yaml. Raises InputError that names file and key."""
    if not isinstance(entries, list):
        raise InputError(f"{path}: effects must be a list")
    found: list[TwinEffect] = []
    for index, entry in enumerate(entries):
        effect = _read_effect(entry, f"{path}: effects[{index}]")
        if any(effect.name == other.name for other in found):
            raise InputError(f"{path}: effects[{index}].effect: {effect.name} is there twice, keep one of them")
        found.append(effect)
    return tuple(found)


def _read_effect(entry: Any, where: str) -> TwinEffect:
    from masiv.effects.catalogue import effect_named

    if not isinstance(entry, dict) or set(entry) != {"effect", "parameters"}:
        raise InputError(f"{where} must have the keys effect and parameters")
    try:
        known = {p.name: p for p in effect_named(str(entry["effect"])).parameters}
    except InputError as error:
        raise InputError(f"{where}.effect: {error}") from error
    given = entry["parameters"]
    if not isinstance(given, dict):
        raise InputError(f"{where}.parameters must hold {', '.join(known)}")
    for name in given:
        if name not in known:
            raise InputError(
                f"{where}.parameters.{name}: {entry['effect']} has no such parameter, it has {', '.join(known)}"
            )
    values, errors = {}, {}
    for name, p in known.items():
        key = f"{where}.parameters.{name}"
        row = given.get(name)
        if not isinstance(row, dict) or "value" not in row:
            raise InputError(f"{key} is missing: give it a value [{p.unit}]")
        if row.get("unit", p.unit) != p.unit:
            raise InputError(f"{key}.unit is {row['unit']}, it must be {p.unit}")
        value, stderr = row["value"], row.get("stderr")
        if not _is_number(value) or not p.lower <= value <= p.upper:
            raise InputError(f"{key}.value is {value}, it must be a number from {p.lower:g} to {p.upper:g} {p.unit}")
        if stderr is not None and not (_is_number(stderr) and stderr >= 0):
            raise InputError(f"{key}.stderr is {stderr}, it must be a number of 0 or more, or null")
        values[name], errors[name] = float(value), None if stderr is None else float(stderr)
    return TwinEffect(entry["effect"], values, errors)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and not math.isnan(value)
