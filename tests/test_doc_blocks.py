"""Blocks of code in README and docs run: Python, with settings that take seconds, and commands that are quick."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from small_run import write_run, write_scene
from test_docs import ROOT, TODAY, command_lines, of

from masiv.scene.declaration import SceneDeclaration
from masiv.strict import validated

PAGES = [page for page in TODAY if page.name == "README.md" or "docs" in page.parts]
TUTORIALS = [page for page in PAGES if page.parent.name == "extend"]  # tests/test_tutorials.py follows them
TINY = Path(__file__).parent / "wheel/tiny.yaml"
PRELUDE = """
import runpy, sys
from pathlib import Path
import masiv
from masiv.config import load_config
masiv.load_config = lambda preset: load_config(preset, Path(sys.argv[2]))
if __name__ == "__main__":
    runpy.run_path(sys.argv[1], run_name="__main__")
"""
"""What runs a block, with the least work that goes through every stage in place of a preset."""
UNLIKE_THE_RUN = ("--render", "--without", "--condition", "--law", "--truth")
"""Options that ask for more than the run that is made by hand has."""


def blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def is_quick(line: str) -> bool:
    """Whether a command takes seconds and asks for nothing that the folder below lacks."""
    _, name, *arguments = shlex.split(line, comments=True)
    if name == "simulate":
        return arguments[0] in ("RUN", "runs/sample") and not any(a.startswith(UNLIKE_THE_RUN) for a in arguments)
    return name in ("config", "--version") or (name == "inspect" and arguments[0] in ("SCENE", "assets/sample"))


PYTHON = [(page, k) for page in PAGES if page not in TUTORIALS for k, _ in enumerate(blocks(page, "python"))]
LINES = sorted({line for page in PAGES for line in command_lines(page.read_text(encoding="utf-8")) if is_quick(line)})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder like that of the repository, with a scene and runs of the names that pages use."""
    folder = tmp_path_factory.mktemp("blocks")
    (folder / "assets").symlink_to(ROOT / "assets")
    write_scene(folder / "SCENE")
    (folder / "runs").mkdir()
    for name in ("RUN", "runs/sample"):
        write_run(folder / name)
    return folder


def run(folder: Path, *arguments: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_there_are_blocks_of_each_kind():
    assert {"README.md", "docs/quick_start.md"} <= {of(page) for page, _ in PYTHON}
    assert {line.split()[1] for line in LINES} >= {"config", "inspect", "--version"}


@pytest.mark.slow
@pytest.mark.parametrize(("page", "k"), PYTHON, ids=[f"{of(page)}:{k}" for page, k in PYTHON])
def test_python_blocks_run(folder, page, k):
    (folder / "block.py").write_text(blocks(page, "python")[k], encoding="utf-8")
    (folder / "prelude.py").write_text(PRELUDE, encoding="utf-8")
    run(folder, "prelude.py", "block.py", str(TINY))


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_quick_commands_run(folder, line):
    run(folder, "-m", "masiv.cli.main", *shlex.split(line, comments=True)[1:])


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_yaml_blocks_are_what_they_seem(page):
    for block in blocks(page, "yaml"):
        if "…" in block:
            continue
        content = yaml.safe_load(block)
        if "fps" in content:
            validated(SceneDeclaration, content, of(page))
