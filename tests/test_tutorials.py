"""The tutorials of docs/extend, followed to the letter in a copy of the package: files, changes, scripts, commands."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TUTORIALS = sorted((ROOT / "docs/extend").glob("*.md"))
BLOCK = re.compile(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```', re.MULTILINE | re.DOTALL)


@pytest.fixture
def copy(tmp_path):
    """The package as it is installed, in a folder of its own."""
    leave = shutil.ignore_patterns("__pycache__", "cli", "assets")
    shutil.copytree(ROOT / "masiv", tmp_path / "masiv", ignore=leave)
    shutil.copytree(ROOT / "cli", tmp_path / "masiv/cli", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "assets/laws", tmp_path / "masiv/assets/laws")
    shutil.copy(ROOT / "assets/__init__.py", tmp_path / "masiv/assets")
    return tmp_path


def changed(text: str, difference: str) -> str:
    """``text`` after a change whose lines begin with a space (there), - (removed) or + (added)."""
    lines = difference.splitlines(keepends=True)
    before = "".join(line[1:] for line in lines if line[0] in " -")
    assert text.count(before) == 1, f"not there, or not once:\n{before}"
    return text.replace(before, "".join(line[1:] for line in lines if line[0] in " +"))


def run(folder: Path, *arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_does_what_it_says(copy, page):
    scripts = 0
    for language, title, block in BLOCK.findall(page.read_text(encoding="utf-8")):
        target = copy / title
        if language == "python" and title:
            assert not target.exists(), title
            target.write_text(block, encoding="utf-8")
        elif language == "diff":
            target.write_text(changed(target.read_text(encoding="utf-8"), block), encoding="utf-8")
        elif language == "python":
            (copy / "script.py").write_text(block, encoding="utf-8")
            assert "masiv/__init__.py" in run(copy, "-c", "import masiv; print(masiv.__file__)")
            run(copy, "script.py")
            scripts += 1
        elif not language:
            for line in block.splitlines():
                if "RUN" not in line:  # of a run that the reader has; parsed in tests/test_docs.py
                    run(copy, "-m", "masiv.cli.main", *shlex.split(line)[1:])
    assert scripts


def test_there_is_a_tutorial_of_each_kind():
    assert {"effect", "law", "reader"} <= {page.stem for page in TUTORIALS}
