"""On a CPU nothing depends on the number of threads. Processes of their own: Taichi starts once in each."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


def on(threads: int) -> list[str]:
    """The number of threads that Taichi had, and the hash."""
    ended = subprocess.run(
        [sys.executable, Path(__file__).with_name("digest.py")],
        env={**os.environ, "TI_CPU_MAX_NUM_THREADS": str(threads)}, stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    return ended.stdout.split()


@pytest.mark.slow
def test_rollout_and_picture_are_the_same_to_the_bit_on_any_number_of_threads():
    (one, alone), (three, shared) = on(1), on(3)
    assert (one, three) == ("1", "3")
    assert alone == shared
