"""twin.yaml of schema 1: one layout for a filmed body, another for tracks. Read only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground
from masiv.strict import shortened, validated
from masiv.twin.body import Body, Boundary, InitialCondition, TwinEffect, with_start_values
from masiv.twin.document import check_names, read_effect, read_particles
from masiv.twin.document_parts import EffectPart

BODY, OBSERVATION = "body", "observation"
"""Names for what had none."""
RENAMED = {
    "aside_1": "lateral_offset_1",
    "aside_2": "lateral_offset_2",
    "above": "vertical_offset",
    "lift": "tip_deflection",
}
"""What was fitted of the start of a run."""


def read_schema1(data: Mapping[str, Any], path: Path, scene: Callable[[], Mapping[str, Any]] | None) -> dict[str, Any]:
    """The fields of a ``Twin``. scene: see ``Twin.load``. Raises InputError."""
    try:
        if data.get("layout") != "tracks":
            return _of_video(data, path)
        if scene is None:
            raise InputError(f"{path} is of schema 1, which does not hold the bodies of tracks: load it with its scene")
        return _of_tracks(data, path, dict(scene()))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError) as error:
        raise InputError(f"{path} is not a twin that can be read ({shortened(error)}): run masiv identify") from error


def _of_video(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    from masiv.materials.load import load_law

    boundary, initial = data["boundary"], data["initial"]
    ground = boundary["ground"]
    if ground is not None:
        ground = Ground(np.array(ground["normal"]), ground["height"]["value"])
    body = Body(
        BODY,
        data["body"]["volume"]["value"],
        data["body"]["density"]["value"],
        load_law(path.parent / data["law"]["file"]),
        read_particles(path.parent / initial["particles"], "positions"),
    )
    start = InitialCondition(
        OBSERVATION, BODY, data["fps"], np.array(initial["velocity"]["value"]), np.array(initial["omega"]["value"])
    )
    return {
        "bodies": (body,),
        "boundary": Boundary(ground, boundary["contact"], boundary["friction"]),
        "gravity": np.array(data["gravity"]["value"]),
        "up": np.array(data["up"]),
        "initial_conditions": (start,),
        "simulator": _simulator(data["simulator"]),
        "effects": _effects(data["effects"], path, (body,), (start,)),
        "fit": data["fit"],
    }


def _simulator(data: Mapping[str, Any]) -> SimulatorConfig:
    renamed = {{"split": "subparticles"}.get(key, key): value for key, value in data.items()}
    return SimulatorConfig.model_validate(renamed)


def _of_tracks(data: Mapping[str, Any], path: Path, scene: dict[str, Any]) -> dict[str, Any]:
    """``scene`` (fields of the twin that the scene describes) with the law, the starts and the effects of ``data``."""
    from masiv.materials.classical import ClassicalLaw

    bodies, kind = scene["bodies"], data["law"]["kind"]
    if kind != "rigid":
        rows = data["law"]["parameters"]
        law = ClassicalLaw(kind, **{name: float(row["value"]) for name, row in rows.items()})
        law.stderr = {name: float(row["stderr"]) for name, row in rows.items() if row["stderr"] is not None}
        bodies = tuple(replace(body, law=law) for body in bodies)
    values = {}
    for name, value in data["starts"].items():
        what, run = str(name).split("@", 1)
        values[f"{RENAMED.get(what, what)}@{run}"] = float(value)
    starts = tuple(with_start_values(start, values) for start in scene["initial_conditions"])
    effects = _effects(data["effects"], path, bodies, starts)
    return {**scene, "bodies": bodies, "initial_conditions": starts, "effects": effects, "fit": data["fit"]}


def _effects(
    rows: list[dict[str, Any]], path: Path, bodies: tuple[Body, ...], starts: tuple[InitialCondition, ...]
) -> tuple[TwinEffect, ...]:
    if not isinstance(rows, list):
        raise InputError(f"{path}: 'effects' must be a list")
    out = []
    for k, row in enumerate(rows):
        part = validated(EffectPart, row, f"{path}: effects.{k}")
        out.append(read_effect(part, f"{path}: 'effects.{k}"))
    check_names(path, bodies, starts, tuple(out))
    return tuple(out)
