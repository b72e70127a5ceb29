"""Shared set-up: two torch threads at most, and Taichi started once, on the CPU."""

import pytest
import torch

torch.set_num_threads(2)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")
