"""Errors: what can be copied, and advice that can be followed."""

from __future__ import annotations

import ast
import copy
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

import masiv
import masiv.cli
from masiv.config import RENAMED_KEYS, Config
from masiv.errors import InputError, MasivError, NonFiniteError

SECTIONS = [name for name, value in Config() if isinstance(value, BaseModel)]
KEY = re.compile(rf"(?<![\w./])(?:{'|'.join(SECTIONS)})\.[a-z]\w*\b(?!\.[a-z])")
FILES = re.compile(r"\.(json|npz|yaml|pt|html)$")


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))])
@pytest.mark.parametrize(
    "error",
    [MasivError("failed"), InputError("bad"), NonFiniteError(7, 3, "faster than a cell")],
    ids=lambda error: type(error).__name__,
)
def test_errors_can_be_copied_and_sent_to_another_process(error, again):
    other = again(error)
    assert type(other) is type(error)
    assert str(other) == str(error)
    assert vars(other) == vars(error)


def texts(source: Path) -> Iterator[str]:
    """Strings in a module that are no docstrings; of an f-string, the parts that are fixed."""
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Expr):
            yield from (
                child.value
                for child in ast.iter_child_nodes(node)
                if isinstance(child, ast.Constant) and isinstance(child.value, str)
            )


def named_keys() -> set[str]:
    """Keys of the configuration, ``section.key``, that strings of the package name."""
    sources = [path for package in (masiv, masiv.cli) for path in Path(package.__path__[0]).rglob("*.py")]
    found = {key for source in sources for text in texts(source) for key in KEY.findall(text)}
    return {key for key in found if not FILES.search(key)}


def test_every_key_that_a_message_names_is_one_of_the_configuration():
    keys = named_keys()
    assert "simulator.grid_nodes" in keys
    config = Config()
    unknown = [
        key
        for key in keys - RENAMED_KEYS.keys()
        if key.partition(".")[2] not in type(getattr(config, key.partition(".")[0])).model_fields
    ]
    assert unknown == []
