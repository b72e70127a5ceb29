"""Every key of a configuration with its value, unit, bounds and description, as data and as YAML that --config reads.

Light: no torch, no taichi.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from masiv.config import Config, nearest_key
from masiv.errors import InputError

WIDTH = 120
_SYMBOLS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


@dataclass(frozen=True)
class Setting:
    """A key of the configuration.

    key: with dots. value: as YAML and JSON hold it. unit: as the description gives it in brackets; "" for a number of
    things, a fraction, a name. bounds: "≥ 1, ≤ 256", or the values that a choice allows; "" if there are none.
    """

    key: str
    value: Any
    unit: str
    bounds: str
    description: str

    @property
    def remark(self) -> str:
        """Description and bounds in one line."""
        return f"{self.description} ({self.bounds})" if self.bounds else self.description


def listing(config: Config, section: str | None = None) -> list[Setting]:
    """The keys of ``config`` in the order of their declaration; those of ``section`` ("reconstruct.calibration", or one
    key) alone if it is given. Raises InputError for a section that is not there, with the nearest one."""
    every = list(_settings(config, config.model_dump(mode="json")))
    if section is None:
        return every
    chosen = [s for s in every if s.key == section or s.key.startswith(f"{section}.")]
    if not chosen:
        raise InputError(f"unknown section '{section[:WIDTH]}': did you mean '{nearest_key(section)}'?")
    return chosen


def as_yaml(settings: list[Setting]) -> str:
    """The settings as nested mappings, each key below a comment that says what it is. ``--config`` reads it back."""
    lines: list[str] = []
    above: list[str] = []
    for setting in settings:
        *sections, name = setting.key.split(".")
        shared = next((i for i, (a, b) in enumerate(zip(above, sections, strict=False)) if a != b), len(above))
        lines += [f"{'  ' * depth}{part}:" for depth, part in enumerate(sections) if depth >= min(shared, len(above))]
        above, indent = sections, "  " * len(sections)
        lines += textwrap.wrap(
            setting.remark, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}#   ",
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        lines.append(f"{indent}{name}: {_in_yaml(setting.value)}")
    return "\n".join(lines)


def _settings(model: BaseModel, values: dict[str, Any], above: str = "") -> Iterator[Setting]:
    for name, field in type(model).model_fields.items():
        part = getattr(model, name)
        if isinstance(part, BaseModel):
            yield from _settings(part, values[name], f"{above}{name}.")
            continue
        text = field.description or ""
        unit = ", ".join(re.findall(r"\[([^\]]+)\]", text))
        yield Setting(above + name, values[name], unit, _bounds(field), text)


def _bounds(field: FieldInfo) -> str:
    """Bounds of a number, or the values that a choice allows."""
    limits = [
        f"{symbol} {getattr(constraint, attribute)}"
        for attribute, symbol in _SYMBOLS.items()
        for constraint in field.metadata
        if getattr(constraint, attribute, None) is not None
    ]
    return ", ".join(limits or map(str, _choices(field.annotation)))


def _choices(annotation: Any) -> list[Any]:
    """The values of the Literal types in an annotation."""
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [choice for part in get_args(annotation) for choice in _choices(part)]


def _in_yaml(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")
