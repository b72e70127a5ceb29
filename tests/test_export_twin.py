"""The law as a table, and the twin as a scene for Newton."""

from __future__ import annotations

import csv
import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import masiv.export as export
from masiv.characterization.curves import drive, in_float64, moduli_at_rest, simple_shear
from masiv.errors import InputError
from masiv.export.newton_material import newton_material
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground
from masiv.tracks.config import TracksConfig
from masiv.tracks.read import read_tracks
from masiv.twin import Twin, TwinEffect
from masiv.twin.from_tracks import twin_of_tracks

ELASTIC = {"youngs_modulus": 3e4, "poissons_ratio": 0.3}
UP = np.array([0.0, 0.0, 1.0])


def table(path):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        test: {k: np.array([float(r[k]) for r in rows if r["test"] == test]) for k in ("time_s", "strain", "stress_pa")}
        for test in dict.fromkeys(row["test"] for row in rows)
    }


def test_slopes_at_rest_are_the_moduli(tmp_path):
    export.write_law_csv(ClassicalLaw("neo_hookean", **ELASTIC), tmp_path / "law.csv", strain=1e-3, rate=0.1)
    curves = table(tmp_path / "law.csv")
    shear, bulk = 3e4 / 2.6, 3e4 / (3 * 0.4)
    slopes = {"uniaxial tension": 3e4, "uniaxial compression": 3e4, "simple shear": shear, "dilation": bulk,
              "compression of the volume": bulk}  # fmt: skip
    assert curves.keys() == slopes.keys()
    for test, slope in slopes.items():
        curve = curves[test]
        top = np.abs(curve["strain"]).argmax()
        assert curve["stress_pa"][top] / curve["strain"][top] == pytest.approx(slope, rel=5e-3)
        assert curve["stress_pa"][-1] == pytest.approx(0, abs=1e-3 * abs(curve["stress_pa"][top]))
    assert curves["uniaxial tension"]["time_s"][-1] == pytest.approx(2 * 1e-3 / 0.1)


def test_a_yielding_law_keeps_a_strain(tmp_path):
    law = ClassicalLaw("von_mises", **ELASTIC, yield_stress=600.0)
    export.write_law_csv(law, tmp_path / "law.csv", strain=0.05)
    curve = table(tmp_path / "law.csv")["uniaxial tension"]
    assert curve["stress_pa"].max() == pytest.approx(600 * math.sqrt(1.5), rel=0.01)  # |s| = sqrt(2/3) sigma
    assert curve["stress_pa"][-1] < -0.9 * curve["stress_pa"].max()
    with pytest.raises(InputError, match="give positive numbers"):
        export.write_law_csv(law, tmp_path / "law.csv", strain=0.0)


def sheared(law, rate=10.0, shear=0.5, log_volume=0.0):
    """sqrt(J2) and pressure [Pa] of ``law`` at the end of a steady shear at ``rate`` [1/s]."""
    amounts = shear * np.arange(1, 201) / 200
    stress = drive(in_float64(law), simple_shear(amounts, log_volume)[:, None], shear / rate / 200)[1][-1, 0]
    pressure = -float(stress.trace()) / 3
    deviator = stress + pressure * torch.eye(3)
    return float(deviator.norm()) / math.sqrt(2), pressure


def test_strength_in_newton_is_that_of_the_law():
    law = ClassicalLaw("von_mises", **ELASTIC, yield_stress=600.0)
    assert newton_material(law)[0]["yield_stress"] == pytest.approx(sheared(law)[0], rel=1e-3)
    sand = ClassicalLaw("drucker_prager", **ELASTIC, friction_angle=35.0)
    size, pressure = sheared(sand, log_volume=-0.02)
    made = newton_material(sand)[0]
    assert made["friction"] * pressure + made["yield_stress"] == pytest.approx(size, rel=1e-3)
    fluid = ClassicalLaw("newtonian", viscosity=40.0, bulk_modulus=1e5)
    made = newton_material(fluid)[0]
    assert made["viscosity"] * 10.0 == pytest.approx(sheared(fluid)[0], rel=0.02)  # s = 2 eta D, |D| = rate / sqrt(2)
    paste = ClassicalLaw("non_newtonian", shear_modulus=1e4, bulk_modulus=5e4, yield_stress=300.0, plastic_viscosity=20)
    made = newton_material(paste)[0]
    assert made["yield_stress"] + made["viscosity"] * 10.0 == pytest.approx(sheared(paste)[0], rel=0.03)


@pytest.mark.parametrize("kind", ["neo_hookean", "von_mises", "drucker_prager", "water"])
def test_moduli_in_newton_are_those_of_the_law(kind):
    more = {"von_mises": {"yield_stress": 600.0}, "drucker_prager": {"friction_angle": 35.0}}.get(kind, {})
    law = ClassicalLaw(kind, **ELASTIC, **more)
    made = newton_material(law)[0]
    e, nu = made["young_modulus"], made["poisson_ratio"]
    shear, bulk = moduli_at_rest(law)
    assert e / (3 * (1 - 2 * nu)) == pytest.approx(bulk, rel=1e-5)
    if kind != "water":
        assert e / (2 * (1 + nu)) == pytest.approx(shear, rel=1e-5)


def free_twin():
    rng = np.random.default_rng(0)
    effects = (
        TwinEffect("gravity_scale", {"relative_change": 0.5}),
        TwinEffect("body_force", {"acceleration_x": 0.0, "acceleration_y": 2.0, "acceleration_z": 0.0}),
        TwinEffect("linear_drag", {"rate": 3.0}),
    )
    return Twin.of_body(
        positions=rng.uniform(size=(50, 3)), velocity=np.array([1.0, 2, 3]), omega=np.array([0.0, 0, 2]),
        gravity=-10 * UP, ground=Ground(UP, 0.1), contact="sticky", volume=0.2, density=800.0, up=UP, fps=30.0,
        law=ClassicalLaw("neo_hookean", **ELASTIC), simulator=SimulatorConfig(), effects=effects,
    )  # fmt: skip


def test_scene_for_newton_loads(tmp_path):
    twin = free_twin()
    notes = export.write_newton_scene(twin, tmp_path / "scene")
    script = runpy.run_path(str(tmp_path / "scene/scene.py"), run_name="scene")  # all but Newton itself
    settings, particles = script["load"](tmp_path / "scene")
    assert particles["masses"].sum() == pytest.approx(0.2 * 800, rel=1e-5)
    assert_allclose(particles["positions"], twin.positions)
    arm = twin.positions - twin.positions.mean(0)
    turning = np.column_stack([-2 * arm[:, 1], 2 * arm[:, 0], 0 * arm[:, 0]])
    assert_allclose(particles["velocities"], turning + np.array([1, 2, 3]), atol=1e-5)
    assert (2 * settings["particle_radius_m"]) ** 3 * 50 == pytest.approx(0.2)
    assert settings["ground"]["normal"] == [0, 0, 1]
    assert settings["ground"]["height_m"] == 0.1
    assert_allclose(settings["gravity_m_s2"], [0, 0, -10 * 1.5 + 2], atol=1e-12)  # y of the simulation is up
    text = (tmp_path / "scene/scene.py").read_text()
    assert any("linear_drag (rate 3 1/s)" in note for note in notes)
    assert not any("body_force" in note for note in notes)
    assert all(f"# - {note}" in text for note in notes)


def test_clamped_particles_are_held_and_rigid_bodies_have_no_scene(tmp_path):
    golden = Path(__file__).parent / "golden"
    simulator = SimulatorConfig(courant_number=0.6, max_substeps_per_frame=4000)
    config = TracksConfig(particles=64, duration=0.22, rollouts=12)
    bar = twin_of_tracks(read_tracks(golden / "bar"), config, simulator, rigid=False)
    bar = bar.with_body(law=ClassicalLaw("neo_hookean", **ELASTIC))
    export.write_newton_scene(bar, tmp_path / "bar")
    with np.load(tmp_path / "bar/particles.npz") as file:
        held = file["masses"] == 0
        start = bar.initial_conditions[0].placement
        assert start is not None
        own = start.to_own(file["positions"].astype(np.float64))
    assert 0 < held.sum() < len(held)
    spacing = (9e-5 / len(own)) ** (1 / 3)
    assert own[held, 2].max() <= -0.05 + spacing < own[~held, 2].min()  # the clamp of the scene: z <= -50 mm
    balls = twin_of_tracks(read_tracks(golden / "balls"), config, simulator, rigid=True)
    with pytest.raises(InputError, match="a rigid body has no material points"):
        export.write_newton_scene(balls, tmp_path / "balls")


def test_a_ground_that_slips_has_the_twins_friction(tmp_path):
    twin = free_twin()
    export.write_newton_scene(replace(twin, boundary=replace(twin.boundary, contact="slip", friction=0.4)), tmp_path)
    script = runpy.run_path(str(tmp_path / "scene.py"), run_name="scene")
    assert script["load"](tmp_path)[0]["ground"]["friction"] == 0.4
