"""What CI names exists: seen here, before CI runs for minutes."""

from __future__ import annotations

import re
from pathlib import Path

from masiv.config import load_config

ROOT = Path(__file__).parents[1]


def test_settings_of_the_wheel_test_are_known():
    assert load_config(path=ROOT / "tests/wheel/tiny.yaml").trajectory.particle_count == 300


def test_files_that_the_workflow_names_exist():
    named = re.findall(r"tests/[\w/]+\.py", (ROOT / ".github/workflows/test.yml").read_text(encoding="utf-8"))
    assert named
    assert [name for name in named if not (ROOT / name).is_file()] == []
