"""The twin of a scene of tracks: law, effects and starts, from which every run is simulated again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from masiv.effects.catalogue import effect_named
from masiv.errors import InputError
from masiv.files import write_yaml
from masiv.inference.model_fit import ModelFit
from masiv.materials.classical import UNITS
from masiv.models.base import EffectTerm
from masiv.strict import read_yaml

SCHEMA = 1
RIGID_KIND = "rigid"
Parameters = dict[str, tuple[float, str, float | None]]
"""Value, unit and standard error (None: not known) by name."""


@dataclass(frozen=True)
class FoundEffect:
    """An effect of the library on ``bodies`` (none: on all) in the runs of ``condition`` (None: in all): (value, unit,
    standard error or None) by parameter. Places are in the body's frame of simulation, see ``places``, where (3,) are
    given in the body's own axes."""

    effect: str
    bodies: tuple[str, ...]
    condition: str | None
    parameters: Parameters
    place: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class TracksTwin:
    """law: kind of a classical law, or rigid; parameters of it as of effects. group: of bodies in flight, None for one
    deformable body. starts: by run, what its start was fitted to be. fit: numbers with units in their names."""

    law: str
    parameters: Parameters
    group: str | None
    effects: tuple[FoundEffect, ...] = ()
    starts: dict[str, float] = field(default_factory=dict)
    fit: dict[str, Any] = field(default_factory=dict)

    def law_values(self) -> dict[str, float]:
        """Parameters of the law by name."""
        return {name: value for name, (value, _, _) in self.parameters.items()}

    def of(self, condition: str) -> tuple[FoundEffect, ...]:
        """The effects that act in the runs of ``condition``."""
        return tuple(e for e in self.effects if e.condition in (None, condition))

    def save(self, folder: Path, name: str = "twin.yaml") -> None:
        """Write it, complete or not at all."""
        document = {
            "schema": SCHEMA,
            "layout": "tracks",
            "group": self.group,
            "law": {"kind": self.law, "parameters": _entries(self.parameters)},
            "effects": [
                {
                    "effect": e.effect,
                    "bodies": list(e.bodies),
                    "condition": e.condition,
                    "parameters": _entries(e.parameters),
                    "place": None if e.place is None else {"value": list(e.place), "unit": "m"},
                }
                for e in self.effects
            ],
            "starts": self.starts,
            "fit": self.fit,
        }
        write_yaml(folder / name, document)

    @classmethod
    def load(cls, folder: Path, name: str = "twin.yaml") -> TracksTwin:
        """Read what ``save`` wrote. Raises InputError where it is missing or is something else."""
        path = folder / name
        if not path.is_file():
            raise InputError(f"{folder} holds no {name}: run masiv identify")
        document = read_yaml(path)
        try:
            if document["schema"] != SCHEMA or document["layout"] != "tracks":
                raise InputError(f"{path} is no twin of tracks of this version of masiv: identify again")
            effects = []
            for entry in document["effects"]:
                effect_named(entry["effect"])
                place = None
                if entry["place"] is not None:
                    x, y, z = (float(v) for v in entry["place"]["value"])
                    place = x, y, z
                effects.append(
                    FoundEffect(
                        entry["effect"], tuple(entry["bodies"]), entry["condition"], _read(entry["parameters"]), place
                    )
                )
            law = document["law"]
            return cls(
                law["kind"], _read(law["parameters"]), document["group"], tuple(effects),
                {str(n): float(v) for n, v in document["starts"].items()}, document["fit"],
            )  # fmt: skip
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{path} is not a twin that can be read ({error}): identify again") from error


def _entries(parameters: Parameters) -> dict[str, Any]:
    return {n: {"value": float(v), "unit": u, "stderr": s} for n, (v, u, s) in parameters.items()}


def _read(entries: Mapping[str, Any]) -> Parameters:
    return {str(n): (float(e["value"]), str(e["unit"]), e["stderr"]) for n, e in entries.items()}


def _known(error: float | None) -> float | None:
    return None if error is None or error == float("inf") else float(error)


def law_parameters(fitted: ModelFit, known: Mapping[str, float]) -> Parameters:
    """The law of ``fitted``, what was not fitted without an error."""
    out: Parameters = {n: (v, UNITS[n], None) for n, v in known.items() if n in UNITS}
    for p in fitted.model.family.parameters:
        out[p.name] = (fitted.values[p.name], UNITS[p.name], _known(fitted.stderr.get(p.name)))
    return out


def found_effect(
    term: EffectTerm, fitted: ModelFit, condition: str | None, place: tuple[float, float, float] | None = None
) -> FoundEffect:
    """A term of ``fitted``."""
    parameters: Parameters = {}
    for p in term.parameters:
        error = _known(fitted.stderr.get(p.name))
        parameters[p.name.removeprefix(f"{term.name}.")] = fitted.values[p.name], term.units[p.name], error
    return FoundEffect(term.effect, term.bodies, condition, parameters, place)


def starts_of(fitted: ModelFit) -> dict[str, float]:
    """What of ``fitted`` belongs to single runs: names such as ``release@run``."""
    mine = {p.name for p in fitted.model.family.parameters}
    of_effects = tuple(fitted.model.effects)
    return {
        n: v
        for n, v in fitted.values.items()
        if n not in mine and "@" in n and not any(n.startswith(f"{term}.") for term in of_effects)
    }
