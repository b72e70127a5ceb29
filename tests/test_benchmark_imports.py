"""Scripts that no test runs take names of masiv that exist."""

from __future__ import annotations

import ast
import importlib
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(p for folder in ("benchmarks", "docs", "examples") for p in (ROOT / folder).rglob("*.py"))


def imported(script: Path) -> list[tuple[str, str]]:
    """(module, name) of all that ``script`` takes from masiv, in functions, too."""
    nodes = [n for n in ast.walk(ast.parse(script.read_text())) if isinstance(n, ast.ImportFrom)]
    return [(n.module, a.name) for n in nodes if n.module and n.module.split(".")[0] == "masiv" for a in n.names]


def exists(module: str, name: str) -> bool:
    found = importlib.import_module(module)
    return hasattr(found, name) or (
        hasattr(found, "__path__") and importlib.util.find_spec(f"{module}.{name}") is not None
    )


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_a_script_imports_exists(script):
    assert [pair for pair in imported(script) if not exists(*pair)] == []


def test_a_name_that_is_gone_is_found():
    assert not exists("masiv.report.numbers", "no_such_numbers")
    assert exists("masiv.report", "numbers")
