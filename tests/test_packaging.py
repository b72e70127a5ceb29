"""What the test of the wheel needs, seen before it runs for minutes."""

from __future__ import annotations

from pathlib import Path

from masiv.config import load_config


def test_settings_of_the_wheel_test_are_known():
    path = Path(__file__).with_name("wheel") / "tiny.yaml"
    assert load_config(path=path).trajectory.particle_count == 300
