"""Shared set-up: Taichi on the CPU, torch on one thread (two spin against each other on a busy machine)."""

import os

import pytest

from masiv.workers import ONE_THREAD

if "PYTEST_XDIST_WORKER" in os.environ:  # as many processes as cores; read when numpy, torch and Taichi start
    os.environ.update(ONE_THREAD)

import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")
