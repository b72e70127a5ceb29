"""The memory that a stage takes: its peak, what its processes have, and what they share once."""

import subprocess
import sys

import numpy as np
import pytest

from masiv.memory import PeakMemory, taken_bytes

LARGE = 400_000_000
"""[bytes], well above what an interpreter with numpy takes."""


@pytest.mark.slow
def test_a_peak_that_is_over_counts():
    before = taken_bytes()
    with PeakMemory(interval=0.02) as memory:
        held = np.ones(LARGE, np.uint8)
        while memory.bytes < before + 0.9 * LARGE:  # until it was sampled
            pass
        del held
    assert before + 0.9 * LARGE < memory.bytes < before + 1.5 * LARGE
    assert taken_bytes() < before + 0.5 * LARGE


def test_memory_of_another_process_counts_and_libraries_that_both_map_count_once():
    alone = taken_bytes()
    holds = f"import numpy, sys; x = numpy.ones({LARGE}, numpy.uint8); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", holds], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdin is not None
        child.stdout.readline()
        both = taken_bytes()
        child.stdin.close()
    assert alone + 0.9 * LARGE < both < alone + 1.5 * LARGE
