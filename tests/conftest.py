"""Shared set-up: Taichi on the CPU; one thread a process, since ``make test`` runs one process a core."""

import os

import pytest

from masiv.runtime import ONE_THREAD

os.environ.update(ONE_THREAD)  # read when numpy, torch and Taichi start

import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def taichi():
    """The ``taichi`` module, running on the CPU."""
    from masiv import runtime

    return runtime.start("cpu")


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium (playwright's ``Browser``); the test is skipped where none is installed."""
    from browser import launched

    with launched() as found:
        yield found


# ---- the cube of tests/cube.py, simulated once a process ------------------------------------------------------------


@pytest.fixture(scope="session")
def body():
    """Particles (343, 3) [m] of the cube."""
    from cube import particles

    return particles()


@pytest.fixture(scope="session")
def seen(taichi):
    """What a fit sees of the elastic cube, and its positions (T, N, 3) [m] over four more frames."""
    from cube import FRAMES, VOLUME, Seen, motion_of

    from masiv.materials.classical import ClassicalLaw

    motion = motion_of(ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3), FRAMES + 4)
    return Seen(motion.positions[:FRAMES], motion.times[:FRAMES], VOLUME), motion.positions


@pytest.fixture(scope="session")
def filmed(seen):
    """A scene with silhouettes of the same motion."""
    from cube import silhouettes_of

    return silhouettes_of(seen[1])
