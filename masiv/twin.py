"""The digital twin: everything that is needed to simulate the object again."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from safetensors.numpy import load_file, save_file

from masiv.errors import InputError
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground

if TYPE_CHECKING:
    from masiv.materials.law import Law

SCHEMA = 1


@dataclass(frozen=True)
class Twin:
    """Geometry, initial motion, law and surroundings of one object. World frame, SI units.

    positions (Q, 3) float32 [m] at frame 0; velocity (3,) [m/s] of the centroid and omega (3,) [rad/s] about it;
    gravity (3,) [m/s^2]; ground: the effective plane (None: no ground); contact, friction: see
    ``masiv.mpm.simulator.Simulator``; volume [m^3]; density [kg/m^3]; up (3,); fps: of the video it came from. fit: how
    the law was found (numbers with units).
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

    def save(self, folder: Path) -> None:
        """Write twin.yaml, law.safetensors and particles.safetensors, each complete or not at all."""
        self.law.save(folder / "law.safetensors")
        temporary = folder / "particles.tmp"
        save_file({"positions": np.ascontiguousarray(self.positions, dtype=np.float32)}, temporary)
        os.replace(temporary, folder / "particles.safetensors")
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
            "boundary": {"ground": ground, "contact": self.contact, "friction": self.friction},
            "body": {"volume": _quantity(self.volume, "m^3"), "density": _quantity(self.density, "kg/m^3")},
            "up": _floats(self.up),
            "fps": self.fps,
            "effects": [],
            "simulator": self.simulator.model_dump(),
            "fit": self.fit,
        }
        temporary = folder / "twin.yaml.tmp"
        temporary.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        os.replace(temporary, folder / "twin.yaml")

    @classmethod
    def load(cls, folder: Path) -> Twin:
        """Read what ``save`` wrote. Raises InputError where it is missing or is something else."""
        from masiv.materials.load import load_law

        path = folder / "twin.yaml"
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
            )
        except (OSError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise InputError(f"{folder} holds no twin that can be read ({error}): run masiv identify") from error


def _floats(values: np.ndarray) -> list[float]:
    return [float(v) for v in values]


def _quantity(value: Any, unit: str) -> dict[str, Any]:
    return {"value": value, "unit": unit}
