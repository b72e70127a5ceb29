"""Each script of examples/ runs and gives what its banner says."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))


def script(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_is_short_and_says_how_it_is_called(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 40
    assert f"python examples/{path.name}" in text
    assert f'"{path.stem}"' in Path(__file__).read_text()  # it is run below


def test_free_fall_with_drag(tmp_path):
    result = script("free_fall_with_drag").main(tmp_path)
    (drag,) = result["accepted"]
    assert drag["effect"] == "quadratic_drag"
    true = 0.12 * 2 * 0.003 / (1.2 * np.pi * 0.02**2)  # C_d = 2 m k / (rho A)
    assert drag["theta"]["drag_coefficient"] == pytest.approx(true, abs=5 * drag["stderr"]["drag_coefficient"])


def test_stress_strain(tmp_path):
    curves = script("stress_strain").main(str(tmp_path / "curves.png"))
    assert curves["neo-Hookean"][2] == pytest.approx(3e4 * 0.02, rel=0.05)  # Young's modulus at small strain
    assert curves["von Mises"][-1] < 0.5 * curves["neo-Hookean"][-1]
    assert (tmp_path / "curves.png").stat().st_size > 1000


@pytest.mark.slow
def test_gradient_of_a_rollout():
    gradient, difference = script("gradient_of_a_rollout").main()
    assert gradient == pytest.approx(difference, rel=1e-5)
    assert abs(gradient) > 1e-3


@pytest.mark.slow
def test_identify_sample_then_simulate_variations(tmp_path, capsys):
    settings = Path(__file__).parent / "wheel" / "tiny.yaml"
    errors = script("identify_sample").main(tmp_path / "run", settings)
    assert 0 < errors["tracked_error_mm"] < 300  # tiny settings: that it runs, not that it is good
    heights = script("simulate_variations").main(tmp_path / "run")
    assert heights["thrown upwards"][1] > heights["as filmed"][1]
    assert heights["on the moon"][4] > heights["as filmed"][4]
    assert "as filmed" in capsys.readouterr().out
