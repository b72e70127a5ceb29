"""Shared set-up: Taichi on the CPU; one thread a process, since ``make test`` runs one process a core."""

import os

import pytest

from masiv.workers import ONE_THREAD

os.environ.update(ONE_THREAD)  # read when numpy, torch and Taichi start

import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")
