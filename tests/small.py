"""One capacity of the simulator for all tests: its kernels are compiled for each, which takes longer than most tests.

For bodies of at most 1024 particles. What a rollout gives does not depend on it.
"""

from __future__ import annotations

import pytest

from masiv.mpm.config import SimulatorConfig

SUBSTEPS, NODES = 64, 1 << 16
SMALL = SimulatorConfig(subparticles=1, grid_nodes=NODES, memory_mb=16)
"""Memory for as many substeps in float32."""


def only_first_quick(cases):
    """Parameters of a test of which all but the first are slow."""
    first, *others = cases
    return [first, *(pytest.param(case, marks=pytest.mark.slow) for case in others)]
