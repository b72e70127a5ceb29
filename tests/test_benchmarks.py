"""What ``make bench`` runs can be run as it runs it: without arguments."""

from __future__ import annotations

import argparse
import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LISTED = re.search(r"^BENCHMARKS = (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
BENCHMARKS = LISTED[1].split() if LISTED else []


class Parsed(Exception):
    """The script got past its arguments; what would come now takes minutes."""


def test_make_bench_runs_something():
    assert BENCHMARKS


@pytest.mark.parametrize("name", BENCHMARKS)
def test_needs_no_arguments(name, monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(parser):
        parse(parser)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    monkeypatch.setattr(sys, "argv", [name])
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    with pytest.raises(Parsed):
        runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
