"""Curves, description and sensitivities of laws against closed formulas and known materials."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small import only_first_quick

from masiv.characterization import curves
from masiv.characterization.describe import Quantity, describe, describe_twin, formatted, paragraph
from masiv.characterization.excitation import Excited, excited_range, perturbed, sensitivities
from masiv.errors import InputError, NonFiniteError
from masiv.materials.classical import ClassicalLaw
from masiv.materials.load import load_law
from masiv.mpm.rollout import at_rest
from masiv.pretraining.pretrain import MATERIALS, pretrained_path
from masiv.report.page import Page
from masiv.report.sections.material import material_section, read_material

SEEN = Excited((0.0005, 0.03), (0.001, 0.3), (-0.01, 0.005), 5.0)


def classical(material):
    kind, parameters = MATERIALS[material]
    return ClassicalLaw(kind, **parameters)


def pretrained(material):
    return load_law(pretrained_path(material))


# ---- curves --------------------------------------------------------------------------------------------------------


def test_moduli_at_rest_are_those_of_the_parameters():
    young, poisson = 3e5, 0.25
    shear, bulk = young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))
    law = ClassicalLaw("von_mises", youngs_modulus=young, poissons_ratio=poisson, yield_stress=5e3)
    assert curves.moduli_at_rest(law) == pytest.approx((shear, bulk), rel=1e-6)
    assert curves.moduli_at_rest(ClassicalLaw("water", youngs_modulus=young, poissons_ratio=poisson)) == pytest.approx(
        (0, bulk - 2 / 3 * shear), rel=1e-6, abs=1e-3
    )


def test_uniaxial_stress_with_free_sides_is_hookes_law_until_it_yields():
    """Hencky elasticity: tau = E ln(lambda) at any strain, and |dev tau| = yield_stress means sqrt(3/2) of it."""
    law = ClassicalLaw("von_mises", youngs_modulus=3e5, poissons_ratio=0.25, yield_stress=5e3)
    curve = curves.uniaxial(law, curves.there_and_back(-0.06, 60), 1e-3)
    limit = math.sqrt(1.5) * 5e3
    expected = np.maximum(3e5 * curve.strain[:60], -limit)
    np.testing.assert_allclose(curve.stress[:60], expected, rtol=1e-5)
    np.testing.assert_allclose(curve.permanent[:60], np.minimum(curve.strain[:60] + limit / 3e5, 0), atol=1e-7)
    # Unloading is elastic from there, until it yields the other way.
    back = 3e5 * (curve.strain[60:] + 0.06) - limit
    np.testing.assert_allclose(curve.stress[60:], np.minimum(back, limit), rtol=1e-4, atol=1)


def test_uniaxial_neo_hookean_meets_its_own_equations():
    law = ClassicalLaw("neo_hookean", youngs_modulus=1e5, poissons_ratio=0.3)
    strains = np.linspace(0.02, 0.3, 15)
    mu, lam = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    curve = curves.uniaxial(law, strains, 1e-3)
    for strain, stress in zip(strains, curve.stress, strict=True):
        # Side: mu (b - 1) + lam ln J = 0 with J = exp(strain) b, by bisection; axial: mu (e^2strain - 1) + lam ln J.
        low, high = 0.3, 1.5
        for _ in range(60):
            b = 0.5 * (low + high)
            low, high = (b, high) if mu * (b - 1) + lam * (strain + math.log(b)) < 0 else (low, b)
        assert stress == pytest.approx(mu * (math.exp(2 * strain) - 1) + lam * (strain + math.log(b)), rel=1e-5)
    np.testing.assert_allclose(curve.permanent, 0, atol=1e-9)


def test_relaxation_time_of_a_maxwell_body():
    viscosity, bulk = 100.0, 1e5
    law = ClassicalLaw("newtonian", viscosity=viscosity, bulk_modulus=bulk)
    shear = curves.moduli_at_rest(law)[0]
    assert curves.relaxation_time(law, 1e-3) == pytest.approx(viscosity / shear, rel=0.1)
    assert curves.relaxation_time(classical("jelly"), 0.1) is None


def test_a_frozen_law_is_the_law():
    law = pretrained("plasticine").double()
    f = torch.eye(3).double() + 0.1 * torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(1)).double()
    known = law.frozen()
    torch.testing.assert_close(known.project(f, 1e-3), law.project(f, 1e-3).detach(), rtol=0, atol=0)
    torch.testing.assert_close(known.stress(f), law.stress(f).detach(), rtol=0, atol=0)


def test_a_frozen_law_computes_its_tables_and_coefficients_once():
    law = curves.in_float64(ClassicalLaw("von_mises", youngs_modulus=1e5, poissons_ratio=0.3, yield_stress=1e3))
    assert law.coefficients(1e-3) is law.coefficients(1e-3)
    assert law.coefficients(1e-3) is not law.coefficients(1e-4)
    neural = pretrained("plasticine")
    assert neural.flow_table(1e-3) is not neural.flow_table(1e-3)  # its parameters may change
    frozen = neural.frozen()
    assert frozen.moduli_table() is frozen.moduli_table()
    assert frozen.flow_table(1e-3) is frozen.flow_table(1e-3)
    for k in range(100):  # what is remembered is bounded
        frozen.flow_table(1e-3 + 1e-5 * k)
    assert len(frozen._known) <= 16
    path = curves.simple_shear(np.linspace(0, 0.2, 5))[:, None]
    slow, quick = (curves.drive(law, path, dt)[1] for dt in (1e-3, 1e-4))
    torch.testing.assert_close(slow, quick, rtol=0, atol=0)  # its yield knows no rate


# ---- description ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("material", only_first_quick(MATERIALS))
def test_a_classical_law_is_its_own_family_with_its_own_parameters(material):
    found = describe(classical(material), SEEN)
    kind, parameters = MATERIALS[material]
    best = found.families[0]
    assert best.kind == kind
    assert best.misfit_percent < 1
    if kind == "water":  # Lame's lambda alone is in it
        values = {name: entry["value"] for name, entry in best.parameters.items()}
        young, poisson = values["youngs_modulus"], values["poissons_ratio"]
        assert young * poisson / ((1 + poisson) * (1 - 2 * poisson)) == pytest.approx(1e5 * 0.3 / (1.3 * 0.4), rel=0.01)
        assert found.quantities["shear modulus"].value is None
        assert "fluid" in found.behaviour
        return
    for name, value in parameters.items():
        assert best.parameters[name]["value"] == pytest.approx(value, rel=0.05), name
    assert found.quantities["Young's modulus"].value == pytest.approx(parameters["youngs_modulus"], rel=1e-3)
    assert found.quantities["Poisson's ratio"].value == pytest.approx(parameters["poissons_ratio"], rel=1e-3)
    if kind == "von_mises":
        assert found.quantities["yield stress"].value == pytest.approx(math.sqrt(1.5) * 5e3, rel=0.02)
        assert "viscosity" not in found.quantities
    if kind == "drucker_prager":
        assert found.quantities["friction angle"].value == pytest.approx(25, rel=0.02)
        assert "under pressure only" in found.behaviour
    if kind == "neo_hookean":
        assert found.quantities["yield stress"].value is None
        assert "none up to the strain observed (30 %)" in paragraph(found)


def test_a_viscous_fluid_gives_back_its_viscosity():
    found = describe(ClassicalLaw("newtonian", viscosity=100.0, bulk_modulus=1e5), SEEN)
    assert found.behaviour == "a viscous fluid"
    assert found.quantities["viscosity"].value == pytest.approx(100, rel=0.02)
    assert found.families[0].kind == "newtonian"


@pytest.mark.slow
@pytest.mark.parametrize("material", only_first_quick(["plasticine", "jelly", "water"]))
def test_pretrained_laws_are_what_they_were_taught(material):
    found = describe(pretrained(material), SEEN)
    if material == "jelly":
        assert found.behaviour == "an elastic solid"
        assert found.quantities["yield stress"].value is None
        assert found.quantities["Young's modulus"].value == pytest.approx(1e5, rel=0.05)
        assert found.families[0].kind == "neo_hookean"
    if material == "plasticine":
        assert "yields" in found.behaviour
        assert found.quantities["yield stress"].value == pytest.approx(math.sqrt(1.5) * 5e3, rel=0.15)
        assert found.families[0].kind in ("von_mises", "non_newtonian")
    if material == "water":
        assert found.quantities["shear modulus"].value is None
        assert found.families[0].kind == "water"


# ---- how well the data determine it --------------------------------------------------------------------------------


def test_excited_range_of_a_known_stretch():
    generator = torch.Generator().manual_seed(0)
    rest = torch.rand(400, 3, generator=generator)
    f = torch.diag(torch.tensor([1.2, 1.2**-0.5, 1.2**-0.5]))
    rate = torch.diag(torch.tensor([3.0, -1.5, -1.5])).expand(400, 3, 3)
    start = at_rest(rest, torch.zeros(400, 3), rate)
    held = 1.05 ** (1 / 3) * torch.eye(3).expand(400, 3, 3)  # what is elastic is a change of volume alone
    later = replace(start, position=rest @ f.T, trial_gradient=held)
    seen = excited_range([start, later])
    assert seen.strain == pytest.approx((math.log(1.2),) * 2, rel=1e-4)
    assert seen.elastic_strain[1] < 1e-6
    assert seen.log_volume == pytest.approx((math.log(1.05),) * 2, rel=1e-4)
    assert seen.rate == pytest.approx(3.0, rel=1e-5)
    with pytest.raises(InputError, match="two frames"):
        excited_range([start])


def test_perturbed_laws_change_one_property_by_what_is_asked():
    for law, tolerance in ((classical("plasticine"), 1e-6), (pretrained("plasticine"), 0.02)):
        shear, bulk = curves.moduli_at_rest(law)
        changed = perturbed(law, 1.1)
        assert curves.moduli_at_rest(changed["shear modulus"]) == pytest.approx((1.1 * shear, bulk), rel=tolerance)
        assert curves.moduli_at_rest(changed["bulk modulus"]) == pytest.approx((shear, 1.1 * bulk), rel=tolerance)
        name = "yield stress" if isinstance(law, ClassicalLaw) else "flow strain"
        assert curves.moduli_at_rest(changed[name]) == pytest.approx((shear, bulk), rel=1e-3)
    assert "shear modulus" not in perturbed(classical("water"))


def test_standard_errors_are_those_of_least_squares():
    """Positions linear in ln G and ln K: standard errors by hand, and nothing for what does not move or diverges."""
    generator = np.random.default_rng(0)
    by_shear, by_bulk = 0.01 * generator.standard_normal((2, 6, 50, 3))
    base = ClassicalLaw("von_mises", youngs_modulus=1e5, poissons_ratio=0.3, yield_stress=1e3)

    def reroll(law):
        if float(law.values["yield_stress"]) != 1e3:
            raise NonFiniteError(1, 2, "test")
        shear, bulk = (math.log(a / b) / math.log(1.1) for a, b in zip(
            curves.moduli_at_rest(law), curves.moduli_at_rest(base), strict=True))  # fmt: skip
        return np.concatenate([np.zeros((1, 50, 3)), shear * by_shear + 0.001 * bulk * by_bulk])

    found = {s.name: s for s in sensitivities(reroll, base, error_mm=30.0)}
    size = 1e3 * np.sqrt((by_shear**2).sum(2).mean())
    assert found["shear modulus"].moved_mm == pytest.approx(size, rel=1e-4)
    assert found["shear modulus"].stderr_percent == pytest.approx(10 * 30 / size / math.sqrt(6), rel=1e-3)
    assert found["bulk modulus"].stderr_percent is None
    assert not found["bulk modulus"].excited
    assert found["yield stress"].moved_mm is None


def test_what_cannot_be_told_apart_has_no_standard_error():
    pattern = np.random.default_rng(0).standard_normal((5, 30, 3))
    base = classical("jelly")

    def reroll(law):
        change = sum(math.log(a / b) for a, b in zip(
            curves.moduli_at_rest(law), curves.moduli_at_rest(base), strict=True))  # fmt: skip
        return np.concatenate([np.zeros((1, 30, 3)), change * pattern])

    found = sensitivities(reroll, base, error_mm=5.0)
    assert {s.name for s in found} >= {"shear modulus", "bulk modulus"}
    assert all(s.excited and s.stderr_percent is None for s in found)


@pytest.mark.slow
def test_a_twin_is_described_with_errors_saved_and_reported(taichi, tmp_path):
    from test_simulate import twin

    body = twin(pretrained("jelly"), velocity=np.array([0, -2.0, 0]))
    body = replace(body, fit={"trajectory_error_mm": 2.0})
    material = describe_twin(body, frames=5)
    stiffness = material.quantities["shear modulus"]
    assert stiffness.stderr_percent is not None
    assert {s.name for s in material.sensitivities} == {
        "shear modulus",
        "bulk modulus",
        "flow strain",
        "relaxation time",
    }
    assert not next(s for s in material.sensitivities if s.name == "flow strain").excited
    assert "Not excited by this motion: " in paragraph(material)
    material.save(tmp_path / "material.json")
    data = read_material(tmp_path)
    assert data is not None
    assert data["summary"] == paragraph(material)
    page = Page("twin")
    material_section(page, data)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "What is this material?" in text
    assert "neo_hookean" in text
    assert read_material(tmp_path / "none") is None
    (tmp_path / "material.json").write_text(json.dumps({"schema": 0}))
    with pytest.raises(InputError, match="another version"):
        read_material(tmp_path)


def test_quantities_are_said_with_fitting_units():
    assert formatted(Quantity(12345.0, "Pa", stderr_percent=14.2)) == "12.3 kPa ± 14 %"
    assert formatted(Quantity(2e6, "Pa", "under pressure")) == "2 MPa (under pressure)"
    assert formatted(Quantity(None, "Pa")) == "none"
    assert formatted(Quantity(0.3, "", stderr_percent=250.0)) == "0.3 ± more than 100 %"
