"""Parameters of classical laws from trajectories simulated with a known one."""

import math

import numpy as np
import pytest
from cube import VELOCITY, noisy, scene
from small import SMALL, only_first_quick

from masiv.checkpoint import Checkpoint
from masiv.identification.classical import shortlist
from masiv.identification.classical.fit import FamilyFit
from masiv.identification.classical.model_selection import rank_by_bic
from masiv.identification.config import IdentifyConfig
from masiv.identification.stage import identify
from masiv.inference.noise_model import effective_samples
from masiv.materials.classical import ClassicalLaw
from masiv.models import families
from masiv.models.families import FAMILIES, law_of


def settings(law, **changes):
    fast = dict(law=law, contact="sticky", search_particles=200, samples_per_frame=1, family_rollouts=30)
    return IdentifyConfig(**(fast | changes))


TRUTHS = {
    "neo_hookean": ({"youngs_modulus": 3e4, "poissons_ratio": 0.3}, {"youngs_modulus": 0.12, "poissons_ratio": 0.3}),
    "von_mises": (
        {"youngs_modulus": 1e5, "poissons_ratio": 0.3, "yield_stress": 2e3},
        {"yield_stress": 0.12},
    ),
    "newtonian": ({"viscosity": 40.0, "bulk_modulus": 1e5}, {"viscosity": 0.15}),
    "springs": ({"youngs_modulus": 1e5, "viscosity": 20.0}, {"youngs_modulus": 0.05, "viscosity": 0.3}),
}


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize("kind", only_first_quick(TRUTHS))
def test_parameters_are_recovered_with_errors_that_cover_them(kind):
    truth, tolerance = TRUTHS[kind]
    twin = identify(scene(), noisy(ClassicalLaw(kind, **truth)), settings(kind), SMALL)
    described = twin.law.description()
    assert described["kind"] == kind
    assert twin.fit["trajectory_error_mm"] < 4
    np.testing.assert_allclose(twin.velocity, VELOCITY, atol=0.03)
    for name, share in tolerance.items():
        entry = described["parameters"][name]
        assert entry["value"] == pytest.approx(truth[name], rel=share)
        assert 0 < entry["stderr"] < 0.5 * truth[name]


@pytest.mark.usefixtures("taichi")
def test_interrupted_fit_of_a_family_ends_with_the_same_numbers(tmp_path):
    class Stop(Exception):
        pass

    stages = []

    def stop_in_the_second_stage(stage, done, total, note=""):
        stages.append(stage)
        if "fit, 8 frames" in stage and done == 5:
            raise Stop

    seen = noisy(ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3))
    config = settings("neo_hookean", family_rollouts=14)
    whole = identify(scene(), seen, config, SMALL)
    path = tmp_path / "identify.pt"
    with pytest.raises(Stop):
        identify(scene(), seen, config, SMALL, checkpoint=Checkpoint(path),
                 progress=stop_in_the_second_stage)  # fmt: skip
    stages.clear()
    resumed = identify(
        scene(), seen, config, SMALL, checkpoint=Checkpoint(path),
        progress=lambda stage, *_: stages.append(stage),
    )  # fmt: skip
    assert stages
    assert not any("search" in stage for stage in stages)
    assert whole.law.description() == resumed.law.description()
    assert whole.fit == resumed.fit
    assert np.array_equal(whole.velocity, resumed.velocity)


@pytest.mark.usefixtures("taichi")
def test_auto_names_the_family_that_moved_so(monkeypatch):
    monkeypatch.setattr(shortlist, "CONTINUUM_FAMILIES", ("newtonian", "neo_hookean"))
    seen = noisy(ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3))
    twin = identify(scene(), seen, settings("auto", family_rollouts=24), SMALL)
    assert twin.fit["law"] == twin.law.kind == "neo_hookean"
    rows = twin.fit["families"]
    assert [row["law"] for row in rows] == ["neo_hookean", "newtonian"]
    assert rows[0]["trajectory_error_mm"] < 0.5 * rows[1]["trajectory_error_mm"]
    assert rows[0]["bic_above_best"] == 0 < rows[1]["bic_above_best"]


def test_ranking_prefers_fewer_parameters_unless_more_explain_more():
    def fit(kind, parameters, rms):
        values = {str(k): 0.0 for k in range(parameters)}
        return FamilyFit(kind, "sticky", values, mean_square=rms**2, samples=100)

    assert [f.kind for f in rank_by_bic([fit("b", 10, 0.0099), fit("a", 9, 0.01)])] == ["a", "b"]
    assert [f.kind for f in rank_by_bic([fit("a", 9, 0.01), fit("b", 10, 0.005)])] == ["b", "a"]


@pytest.mark.parametrize("kind", list(FAMILIES))
def test_every_candidate_is_a_law_within_its_bounds(kind):
    family = FAMILIES[kind].scaled(1500.0)
    for values in family.candidates():
        assert law_of(family, values).wave_modulus() > 0
        for parameter in family.parameters:
            assert parameter.lower <= values[parameter.name] <= parameter.upper
    assert families.FAMILIES[kind].candidates()[0] != family.candidates()[0]


def test_effective_samples_of_known_fields():
    random = np.random.default_rng(1)
    positions = random.uniform(0, 1, (500, 3))
    white = random.normal(size=(20, 500, 3))
    assert effective_samples(white, positions) > 0.5 * white.size
    assert effective_samples(np.ones((20, 500, 3)), positions) == 3
    still = np.repeat(random.normal(size=(1, 500, 3)), 20, axis=0)
    assert effective_samples(still, positions) == pytest.approx(3 * 500, rel=0.15)
    together = np.repeat(random.normal(size=(20, 1, 3)), 500, axis=1)
    assert effective_samples(together, positions) == pytest.approx(3 * 20, rel=0.4)
    assert math.isfinite(effective_samples(np.zeros((2, 5, 3)), positions[:5]))
