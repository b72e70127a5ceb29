"""Shared set-up: one torch thread (two that wait for each other are 50 times slower on a busy machine), Taichi on the CPU."""

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")
