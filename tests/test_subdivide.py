"""Particles in parts: what a prediction simulates in place of what was fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from masiv.errors import InputError
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.simulation.simulate import simulate
from masiv.simulation.subdivide import PATTERNS, merge_subparticles, subdivide_particles, subdivide_twin
from masiv.twin import Twin

SPACING, FRAMES = 0.02, 13


def bar(omega: float, **simulator) -> Twin:
    """Two particles thick, about a cell and a half, spinning about its middle in empty space."""
    axes = [(np.arange(n) + 0.5) * SPACING for n in (24, 2, 2)]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    return Twin.of_body(
        positions=positions, velocity=np.zeros(3), omega=np.array([0.0, 0.0, omega]), gravity=np.zeros(3), ground=None,
        contact="none", friction=0.0, volume=len(positions) * SPACING**3, density=1000.0, up=np.array([0.0, 1.0, 0.0]),
        fps=24.0, law=ClassicalLaw("neo_hookean", youngs_modulus=1e4, poissons_ratio=0.3),
        simulator=SimulatorConfig(particles_per_cell=3.0, grid_nodes=1 << 17, memory_mb=200, **simulator),
    )  # fmt: skip


def widest_gap(points: np.ndarray, cell: float) -> float:
    """Between neighbours along the bar's longest axis, in cells."""
    arms = points - points.mean(axis=0)
    along = np.sort(arms @ np.linalg.svd(arms, full_matrices=False)[2][0])
    return float(np.diff(along).max()) / cell


@given(st.sampled_from(sorted(PATTERNS)), st.integers(1, 30), st.floats(1e-3, 1.0))
def test_parts_are_the_particle(parts, count, spacing):
    positions = np.random.default_rng(count).uniform(-1, 1, (count, 3)).astype(np.float32)
    made = subdivide_particles(positions, spacing, parts)
    assert made.shape == (parts * count, 3)
    np.testing.assert_allclose(merge_subparticles(made[None], count)[0], positions, atol=2e-7)
    arms = (made.reshape(count, parts, 3) - positions[:, None]).astype(np.float64)
    assert np.abs(arms).max() <= 0.25 * spacing + 2e-7  # within its cube
    second = np.einsum("npi,npj->ij", arms, arms) / len(made)
    expected = np.eye(3) * (spacing / 4) ** 2 * (parts > 1)  # no direction is preferred
    np.testing.assert_allclose(second, expected, atol=2e-7)
    if parts == 1:
        np.testing.assert_array_equal(made, positions)


def test_the_grid_stays():
    whole = bar(0.0, subparticles=8)
    fine = subdivide_twin(whole)
    cells = [grid_spacing(t.volume, len(t.positions), t.simulator) for t in (whole, fine)]
    assert cells[0] == pytest.approx(cells[1], rel=1e-12)
    np.testing.assert_array_equal(subdivide_twin(fine).positions, fine.positions)  # once


def test_what_are_not_parts():
    with pytest.raises(InputError, match="not parts of 4"):
        merge_subparticles(np.zeros((2, 10, 3)), 4)


@pytest.mark.usefixtures("taichi")
def test_a_bar_that_cannot_break_does_not():
    """A neo-Hookean bar that spins at 12 rad/s is drawn to 1.4 times its length and springs back. In whole particles it
    tears, at gaps of little more than a cell; in parts it holds."""
    whole, parts = (simulate(bar(12.0, subparticles=n), frames=FRAMES).positions for n in (1, 4))
    cell = 3.0 ** (1 / 3) * SPACING
    assert np.ptp(parts[3], axis=0)[:2].max() > 1.2 * np.ptp(parts[0], axis=0).max()  # it is drawn
    assert max(widest_gap(points, cell) for points in parts) < 0.7
    assert widest_gap(whole[-1], cell) > 5.0
    # Until the tear both are the same motion.
    same = np.linalg.norm(merge_subparticles(parts[:2], whole.shape[1]) - whole[:2], axis=2)
    assert same.max() < 0.1 * SPACING


@pytest.mark.usefixtures("taichi")
def test_flight_is_that_of_the_merge_subparticles():
    """Without stress, particles and their parts fly alike: the centre by the parabola, to rounding."""
    flying = replace(bar(0.0).with_motion(velocity=np.array([1.0, 2.0, -0.5])), gravity=np.array([0.0, -9.8, 0.0]))
    motion = simulate(flying, frames=5, substeps=50)
    t = motion.times[:, None]
    late = t / (50 * flying.fps)  # symplectic Euler is half a substep ahead
    exact = flying.velocity * t + 0.5 * flying.gravity * (t**2 + late)
    np.testing.assert_allclose(motion.positions.mean(1) - flying.positions.mean(0), exact, atol=2e-5)
