"""Typed input from YAML and JSON: an unknown key is an error that names the nearest known key."""

from __future__ import annotations

import difflib
import json
import reprlib
from collections.abc import Hashable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from masiv.errors import InputError
from masiv.files import require_file

Model = TypeVar("Model", bound=BaseModel)
UNREADABLE = (ValueError, RecursionError, OverflowError, MemoryError)
"""What parsers raise, besides errors of their own, for text that is nested too deep, for numbers with thousands of
digits and for dates that do not exist."""
_SHOWN = 80
"""Characters of a value that a message quotes."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice: YAML forbids it, and the library takes the last one without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [child.value for child, _ in node.value if isinstance(child, yaml.ScalarNode)]
        for key in keys:
            if key != "<<" and keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; {} for an empty file. Raises InputError where it cannot be one."""
    data = parsed_yaml(_text(path), str(path))
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold `key: value` lines, found a {type(data).__name__}")
    return data


def parsed_yaml(text: str, where: str) -> Any:
    """What ``text`` says in YAML. Raises InputError that names ``where`` if it is not YAML."""
    try:
        return yaml.load(text, _Loader)  # a SafeLoader
    except (yaml.YAMLError, *UNREADABLE) as error:
        detail = shortened(error).replace(' in "<unicode string>"', "")
        raise InputError(f"{where} is not valid YAML: {detail}") from error


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises InputError if it is missing or not JSON."""
    try:
        return json.loads(_text(path))
    except UNREADABLE as error:
        raise InputError(f"{path} is not valid JSON: {shortened(error)}") from error


def shortened(value: object) -> str:
    """``value``, for example an error, as one line of a message that is not too long to read."""
    text = " ".join(str(value).split()) or type(value).__name__
    return text if len(text) <= 2 * _SHOWN else f"{text[: 2 * _SHOWN]}…"


def reason(error: Exception, path: Path) -> str:
    """Why ``path`` could not be read, for a sentence that names it already."""
    return shortened(str(error).removeprefix(str(path)).lstrip(": ") or type(error).__name__)


def quoted(value: object) -> str:
    """``value`` as Python writes it, cut where it is long; one that contains itself or much of other values, too."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = _SHOWN
    short.maxlevel = 2
    try:
        return short.repr(value)
    except UNREADABLE:  # an integer with more digits than Python converts to text
        return f"a {type(value).__name__} with very many digits"


def _text(path: Path) -> str:
    require_file(path)
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8: {error.reason} at byte {error.start}") from error


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
    if first["type"] == "missing":
        return f"{where}: '{dotted}' is missing"
    if first["type"] != "extra_forbidden":
        return f"{where}: '{dotted}' is {quoted(first['input'])}: {first['msg'][:1].lower() + first['msg'][1:]}"
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
