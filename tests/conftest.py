"""Shared set-up: Taichi on the CPU, torch on one thread (two spin against each other on a busy machine)."""

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")
