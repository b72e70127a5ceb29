"""Typed input from YAML: an unknown key is an error that names the nearest known key."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from masiv.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; {} for an empty file. Raises InputError where it cannot be one."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold `key: value` lines, found a {type(data).__name__}")
    return data


def validated(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """``data`` as a ``model``. Raises InputError with the first problem found in ``where`` (a file's name)."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError(_sentence(model, error, where)) from error


def _sentence(model: type[BaseModel], error: ValidationError, where: str) -> str:
    problems = error.errors()
    first = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    location = [str(part) for part in first["loc"]]
    dotted = ".".join(location)
    if first["type"] != "extra_forbidden":
        return f"{where}: '{dotted}' is {first['input']!r}: {first['msg'][:1].lower() + first['msg'][1:]}"
    known = _keys_at(model, location[:-1])
    near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.0)
    hint = f"did you mean '{'.'.join([*location[:-1], near[0]])}'?" if near else "it takes no key there"
    return f"{where}: unknown key '{dotted}': {hint}"


def _keys_at(model: type[BaseModel], location: list[str]) -> list[str]:
    """The known keys of the model nested at ``location``."""
    current: Any = model
    for part in location:
        fields = getattr(current, "model_fields", {})
        if part not in fields:
            continue  # pydantic adds the name of a union's member or an index, which is no field
        current = _model_in(fields[part].annotation)
    return list(getattr(current, "model_fields", {}))


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
