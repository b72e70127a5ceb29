"""The report's first screen, and the numbers in it."""

from __future__ import annotations

import numpy as np
import pytest
from refined_by_hand import document

from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.refinement.answer import advice, answer
from masiv.report.quantities import millimetres, percent, quantity
from masiv.report.sections.answer import Agreement, answer_cards
from masiv.scene.scene import Ground
from masiv.twin import Twin

UP = np.array([0.0, 1.0, 0.0])


def twin(stderr=None):
    law = ClassicalLaw("neo_hookean", youngs_modulus=112345.0, poissons_ratio=0.3)
    law.stderr = stderr or {}
    points = np.random.default_rng(0).random((20, 3)).astype(np.float32)
    return Twin.of_body(
        positions=points, velocity=np.zeros(3), omega=np.zeros(3), gravity=-9.8 * UP, ground=Ground(UP, 0.0),
        contact="sticky", volume=0.027, density=1000.0, up=UP, fps=24.0, law=law, simulator=SimulatorConfig(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ((111938.9, "Pa", 37339.0), "112 ± 37 kPa"),
        ((0.7234, "1/s", 0.0213), "0.723 ± 0.021 1/s"),
        ((0.3, "1", None), "0.3"),
        ((5.0, "Pa", float("inf")), "5 Pa"),
        ((2.5e-9, "m", 1e-9), "2.5e-09 ± 1e-09 m"),
        ((0.2342, "m/s^2", None), "0.234 m/s²"),
        ((12.0, "kg", 340.0), "12 ± 3.4e+02 kg"),
    ],
)
def test_a_value_has_as_many_digits_as_its_error(given, text):
    assert quantity(*given) == text


def test_probabilities_and_lengths_are_readable():
    assert [percent(p) for p in (0.0, 0.0021, 0.05, 0.5, 0.97, 1.0)] == [
        "less than 0.1 %", "0.2 %", "5.0 %", "50 %", "97.0 %", "more than 99.9 %",
    ]  # fmt: skip
    assert [millimetres(v) for v in (0.0, 0.0307, 9.897, 24.38, 916.2)] == [
        "0 mm", "0.0307 mm", "9.90 mm", "24.4 mm", "916 mm",
    ]  # fmt: skip


def test_an_effect_that_was_added():
    made, acts, far, sure = answer_cards(twin({"youngs_modulus": 2000.0}), None, [document()], [], 0.6)
    assert "neo-Hookean" in made.answer
    assert made.lines[0] == "Young's modulus: 112.3 ± 2.0 kPa"
    assert acts.answer == "Linear drag"
    assert acts.lines[0] == "Linear drag: rate 0.723 ± 0.021 1/s"
    assert "quadratic drag" in acts.lines[1]
    assert far.answer == "40.2 mm → 13.1 mm"  # the frames for validation: this document has no test
    assert "10.7 mm → 4.20 mm" in far.lines[1]
    assert sure.answer == "Effect added"
    assert "without any effect: 0.2 %" in " ".join(sure.lines)
    assert not any(card.open for card in (made, acts, far, sure))


def test_errors_of_another_model_are_named_as_such():
    """Without an added effect, refine's residual is that of its classical law, not of the twin."""
    found = document(
        accepted=[], verdict="nothing missing", null_probability=0.8, after=document()["before"], credible_set=[]
    )
    _, acts, far, sure = answer_cards(twin(), None, [found], [Agreement(9.9, "mean distance from the true motion")])
    assert far.answer == "9.90 mm"
    assert "40.2 mm" in far.lines[1]
    assert "classical law that masiv refine fitted" in far.lines[1]
    assert acts.answer == "Nothing that this motion shows"
    assert sure.answer == "Nothing missing"
    assert "Not excluded" not in " ".join(sure.lines)
    found["credible_set"] = [{"effects": [], "probability": 0.8}, {"effects": ["viscosity"], "probability": 0.16}]
    _, _, _, sure = answer_cards(twin(), None, [found], [])
    assert "Not excluded: viscosity (16 %)." in sure.lines
    assert "→" not in " ".join([far.answer, *far.lines])


@pytest.mark.parametrize("verdict", ["cannot tell", "unexplained residual", "ranked only"])
def test_an_answer_that_is_none_is_marked(verdict):
    found = document(accepted=[], verdict=verdict)
    _, acts, _, sure = answer_cards(twin(), None, [found], [])
    assert acts.open
    assert sure.open
    assert acts.answer == "No effect is named"
    assert len(sure.lines[0]) > 20  # in words


def test_what_cannot_be_told_is_told_apart_from_what_may_act():
    """Advice comes only where errors that are expected hide as much as is left; it names the larger ones."""
    sets = [{"effects": ["viscosity"], "probability": 0.93}, {"effects": [], "probability": 0.07}]
    found = document(accepted=[], verdict="cannot tell", credible_set=sets, discretization_mm={"fit": 10.7})
    assert answer(found) == "cannot tell: viscosity 0.93, no effect 0.07"
    _, _, _, sure = answer_cards(twin(), None, [found], [])
    assert "refine.particles" in sure.lines[-1]
    assert "more cameras" in (advice(found | {"observation_error_mm": {"fit": 10.8}}) or "")
    assert advice(found | {"discretization_mm": {"fit": 10.6}}) is None
    assert advice(found | {"verdict": "nothing missing"}) is None
    assert answer(found | {"credible_set": sets[:1]}) == "cannot tell"


def test_what_was_not_asked_is_said():
    _, acts, far, sure = answer_cards(twin(), None, [], [])
    assert acts.open
    assert sure.open
    assert far.open
    assert "masiv refine" in acts.lines[0]
    assert far.answer == "Not measured"


def test_a_learnt_law_is_told_in_measured_quantities():
    material = {
        "behaviour": "an elastic solid",
        "quantities": {
            "Young's modulus": {"value": 1.1e5, "unit": "Pa", "note": "", "stderr_percent": 33.0},
            "bulk modulus": {"value": 7e4, "unit": "Pa", "note": "not excited", "stderr_percent": None},
        },
        "families": [{"kind": "neo_hookean", "misfit_percent": 17.5, "parameters": {}}],
        "sensitivities": [{"name": "bulk modulus", "excited": False}],
    }
    learnt = twin()
    learnt.law.description = lambda: {
        "kind": "neural",
        "parameters": {"shear_modulus_at_rest": {"value": 1, "unit": "Pa"}},
    }
    made, _, _, sure = answer_cards(learnt, material, [], [])
    assert made.answer == "An elastic solid"
    assert made.lines[0] == "Young's modulus: 110 ± 36 kPa"
    assert len(made.lines) == 2  # a quantity that the motion does not tell is left to the table
    assert "17 %" in made.lines[1] or "18 %" in made.lines[1]
    assert "bulk modulus" in " ".join(sure.lines)
