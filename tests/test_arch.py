"""Every kernel on Vulkan against the CPU, and a tiny identify. Skipped where Taichi finds no Vulkan device."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_pipeline import SPEC, TINY, done

pytestmark = pytest.mark.slow
TOLERANCE = 2e-5
"""Of a result's norm: a hundred roundings of float32 and more, since sums are taken in another order."""
STARTS = "import taichi as ti; ti.init(arch=ti.vulkan); assert ti.lang.impl.current_cfg().arch == ti.vulkan"


@pytest.fixture(scope="module", autouse=True)
def _vulkan():
    """Skips where there is no device."""
    if subprocess.run([sys.executable, "-c", STARTS], capture_output=True, check=False).returncode:
        pytest.skip("no Vulkan device: apt-get install mesa-vulkan-drivers gives one without a GPU")


def results(arch, folder):
    file = folder / f"{arch}.npz"
    script = Path(__file__).with_name("arch_results.py")
    ended = subprocess.run([sys.executable, script, arch, file], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    with np.load(file) as found:
        return dict(found)


def test_results_on_vulkan_are_those_on_the_cpu(tmp_path):
    cpu, vulkan = (results(arch, tmp_path) for arch in ("cpu", "vulkan"))
    assert cpu.keys() == vulkan.keys()
    for name, expected in cpu.items():
        norm = np.linalg.norm(expected)
        assert np.linalg.norm(vulkan[name] - expected) <= TOLERANCE * norm, name
        assert norm > 0 or not expected.size, name


def test_float64_is_refused_in_one_sentence(tmp_path):
    code = (
        "import torch; from masiv import runtime; runtime.start('vulkan'); from effect_cases import body, simulator\n"
        "simulator(8, dtype=torch.float64)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    last = ended.stderr.splitlines()[-1]
    assert last.endswith("needs float64, which --arch vulkan lacks: use --arch cpu or cuda")


def test_a_tiny_identify_runs_on_vulkan(tmp_path):
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    done("synth", tmp_path / "spec.yaml", "--out", tmp_path / "scene")
    errors = {}
    for arch in ("cpu", "vulkan"):
        run = tmp_path / arch
        done("identify", tmp_path / "scene", "--out", run, "--config", tmp_path / "tiny.yaml", "--arch", arch)
        evaluated = done("evaluate", run, "--truth", tmp_path / "scene" / "gt", "--arch", arch)
        errors[arch] = evaluated["motion"]["twin"]["observed"]["tracked_error_mm"]
    # 120 steps of a stochastic fit drift apart from the first rounding on.
    assert errors["vulkan"] == pytest.approx(errors["cpu"], rel=0.25)
