"""Measured bodies in the simulator: filled, attached, clamped, let go."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml
from small import SMALL

from masiv.effects.catalogue import effects
from masiv.errors import MasivError
from masiv.materials.classical import ClassicalLaw
from masiv.models.attachment import attach
from masiv.models.marked_body import marked_body
from masiv.mpm.rollout import at_rest
from masiv.tracks.declaration import GeometryDeclaration
from masiv.tracks.geometry import fill_geometry, make_geometry
from masiv.tracks.read import read_tracks

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from dissipation import bar, cantilever_hz, swing

F64 = torch.float64
CONFIG = SMALL.model_copy(update={"particles_per_cell": 8, "courant_number": 0.5, "max_substeps_per_frame": 1000})


def lattice(spacing=0.1, count=6):
    axis = spacing * (np.arange(count) + 0.5)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def test_affine_motion_is_reproduced():
    """Amid the particles, on the surface, and on a stalk outside."""
    generator = np.random.default_rng(0)
    particles = lattice() + 0.03 * generator.uniform(-1, 1, (216, 3))
    markers = np.array([[0.31, 0.27, 0.33], [0.6, 0.3, 0.2], [0.0, 0.0, 0.0], [0.8, 0.3, 0.3], [0.3, -0.15, 0.7]])
    tied = attach(particles, markers, 0.1)
    matrix, shift = generator.normal(size=(3, 3)), generator.normal(size=3)
    moved = tied.apply(particles @ matrix.T + shift)
    np.testing.assert_allclose(moved, markers @ matrix.T + shift, rtol=0, atol=1e-9)
    assert tied.gain[0] < 1.2
    assert tied.distance[3] > 0.2
    assert (tied.gain < 6).all()


def test_marker_is_no_nearest_particle():
    """Under a smooth motion that is not affine the marker follows to second order in the spacing."""
    error = []
    for count in (6, 12):
        particles = lattice(0.6 / count, count)
        markers = np.array([[0.31, 0.27, 0.333]])
        moved = attach(particles, markers, 0.6 / count).apply(np.sin(2 * particles))
        error.append(np.abs(moved - np.sin(2 * markers)).max())
    assert error[1] < 0.3 * error[0]
    assert error[1] < 5e-3


def test_attachment_is_differentiable():
    particles = torch.as_tensor(lattice())
    tied = attach(lattice(), np.array([[0.31, 0.27, 0.33], [0.8, 0.3, 0.3]]), 0.1)
    batch = torch.stack([particles, 2 * particles]).requires_grad_()
    markers = tied.apply(batch)
    np.testing.assert_allclose(markers.detach(), tied.apply(batch.detach().numpy()))
    markers[1, 1].sum().backward()
    assert batch.grad[0].abs().max() == 0
    torch.testing.assert_close(batch.grad[1].sum(0), torch.ones(3, dtype=F64))


def test_one_layer_carries_no_marker():
    sheet = lattice()
    with pytest.raises(MasivError, match="plane"):
        attach(sheet[np.abs(sheet[:, 2] - 0.05) < 1e-9], np.array([[0.3, 0.3, 0.1]]), 0.1)


@pytest.mark.parametrize("shape", ["box", "sphere", "cylinder", "mesh"])
def test_filling_has_the_volume_and_the_moments(shape, tmp_path):
    declared = {"box": {"box": (20, 30, 50)}, "sphere": {"sphere": 40}, "mesh": {"mesh": tmp_path / "egg.stl"},
                "cylinder": {"cylinder": {"diameter": 30, "length": 40}}}[shape]  # fmt: skip
    egg = trimesh.creation.icosphere(subdivisions=3, radius=20)
    egg.apply_scale([1, 1.5, 0.7])
    egg.apply_translation([100, 5, 0])
    egg.export(tmp_path / "egg.stl")
    geometry = make_geometry(GeometryDeclaration(units="mm", **declared), tmp_path)
    points = fill_geometry(geometry, 2.2e-3)
    solid = trimesh.Trimesh(geometry.vertices, geometry.faces)
    assert geometry.volume == pytest.approx(solid.volume, rel=0.02)
    assert len(points) * 2.2e-3**3 == pytest.approx(geometry.volume, rel=0.1)  # in whole cells
    np.testing.assert_allclose(points.mean(0), solid.center_mass, atol=3e-4)
    np.testing.assert_allclose(points.var(0), np.diag(_second_moments(solid)), rtol=0.04)


def _second_moments(solid):
    inertia = solid.moment_inertia / solid.volume
    return 0.5 * np.trace(inertia) * np.eye(3) - inertia


def test_mass_and_place_in_the_simulator():
    scene = bar()
    body = marked_body(scene, scene.runs[0], CONFIG, particle_spacing=5e-3)
    assert body.mass == pytest.approx(1070 * 9e-5, rel=1e-6)
    assert body.context(1.0, 0.01).particle_mass * len(body.particles) == pytest.approx(body.mass, rel=1e-12)
    assert body.gravity == pytest.approx(np.array([0, -9.8, 0]))  # up is an axis of the grid
    normal, height = body.clamps[0].normals[0].numpy(), body.clamps[0].heights[0].item()
    along = np.abs(normal).argmax()
    assert height * normal[along] / body.spacing == pytest.approx(
        round(height * normal[along] / body.spacing), abs=1e-9
    )
    depth = body.particles.numpy() @ normal - height
    assert depth.min() == pytest.approx(2.5e-3, abs=1e-9)
    assert depth.max() == pytest.approx(0.1 - 2.5e-3, abs=1e-9)
    np.testing.assert_allclose(body.markers_to_world(body.particles[None])[0], [[0, 0, 0.1]], atol=1e-9)


@pytest.mark.slow
def test_clamp_holds_against_effects_and_has_no_part_in_gradients(taichi):
    """Within the clamp nothing moves at all, whatever acts there; the gradient of a drag beside it is right."""
    scene = bar()
    body = marked_body(scene, scene.runs[0], CONFIG, particle_spacing=7.5e-3)
    (clamp,) = body.clamps
    clamp = replace(clamp, heights=clamp.heights + 0.045)
    body = replace(body, clamps=(clamp,))
    law = ClassicalLaw("neo_hookean", youngs_modulus=5e4, poissons_ratio=0.3)
    substep = body.substep(law, np.array([0, 0.02]))
    steps = round(0.02 / substep)
    depth = body.particles @ clamp.normals[0] - clamp.heights[0]

    def moved(rate):
        active = body.effects(((effects()["linear_drag"], rate),), body.context(0.02, 0.02))
        state = at_rest(body.particles, 0.3 * torch.ones_like(body.particles), torch.zeros(len(depth), 3, 3, dtype=F64))
        moved = body.rollout(law, state, [steps], substep=substep, contact="none", effects=active)
        return moved[0] - body.particles

    rate = torch.tensor([2.0], dtype=F64, requires_grad=True)
    path = moved(rate)
    assert (depth < -body.spacing).sum() > 50
    assert path[depth < -body.spacing].abs().max() == 0
    assert path[depth > 0.045].norm(dim=1).min() > 5e-3
    weights = torch.rand(path.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    (weights * path).sum().backward()
    step = torch.tensor([1e-3], dtype=F64)
    with torch.no_grad():
        slope = (weights * (moved(rate + step) - moved(rate - step))).sum() / 2e-3
    assert rate.grad.item() == pytest.approx(slope.item(), rel=1e-6)


@pytest.mark.slow
def test_cantilever_swings_with_its_frequency_and_is_read_back(taichi, tmp_path):
    """A synthetic twin of a measured beam: two grids, both near Timoshenko's frequency, the finer one nearer."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=264e3, poissons_ratio=0.0001)
    theory = cantilever_hz(264e3, 0.0)
    times, scene = np.arange(0, 0.25, 5e-3), bar()
    errors = []
    for cells in (3, 4):
        body = marked_body(scene, scene.runs[0], CONFIG, particle_spacing=0.015 / cells)
        tip = body.markers_to_world(body.run(law, times)[1])
        hz, decay, amplitude = swing(times, tip[:, 0, 0], theory)
        errors.append(abs(hz / theory - 1))
        assert 0 < decay < 1
        assert amplitude == pytest.approx(_sag(264e3), rel=0.12)
    assert errors[0] < 0.06
    assert errors[1] < 0.8 * errors[0]
    header = "time_s,tip_x_mm,tip_y_mm,tip_z_mm"
    rows = [f"{t:.6f}," + ",".join(f"{1e3 * v:.9f}" for v in p) for t, p in zip(times, tip[:, 0], strict=True)]
    (tmp_path / "swing.csv").write_text("\n".join([header, *rows]))
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({
        "layout": "tracks", "up_axis": "x",
        "bodies": {"bar": {"density": 1070,
                           "geometry": {"box": [0.03, 0.03, 0.1], "units": "m", "position": [0, 0, 0.05]},
                           "clamp": {"half_space": {"normal": [0, 0, 1], "height": -0.05}}}},
        "runs": [{"file": "swing.csv", "release_time": 0.0}],
    }))  # fmt: skip
    read = read_tracks(tmp_path)
    np.testing.assert_allclose(read.runs[0].positions, tip, atol=1e-9)
    again = marked_body(read, read.runs[0], CONFIG, particle_spacing=0.015 / 4)
    torch.testing.assert_close(again.particles, body.particles)
    np.testing.assert_allclose(again.markers_to_world(again.run(law, times)[1]), tip, atol=2e-6)


def _sag(youngs, thickness=0.03, length=0.1):
    """Static deflection [m] of the tip under the bar's own weight, bending and shear."""
    line, inertia = 1070 * 9.8 * thickness**2, thickness**4 / 12
    return line * length**4 / (8 * youngs * inertia) + line * length**2 / (2 * 5 / 6 * youngs / 2 * thickness**2)
