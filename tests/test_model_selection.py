"""Families are compared by their image loss if there are pictures, whatever their paths say."""

import dataclasses

import pytest
from cube import OMEGA, VELOCITY, objective_of, scene

from masiv.checkpoint import Checkpoint
from masiv.identification.classical import shortlist
from masiv.identification.classical.fit import FURTHER, FamilyFit
from masiv.identification.classical.model_selection import image_losses, rank_by_image_loss
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.workers import Workers

TRUE = {"youngs_modulus": 3e4, "poissons_ratio": 0.3}
WRONG = {"viscosity": 40.0, "bulk_modulus": 1e5}


def fitted(objective, kind, values, mean_square):
    state = InitialState.of_world(objective.problem.axes, VELOCITY, OMEGA)
    start = initial_state_parameters(state, objective.ground_range)
    every = {**values, **{p.name: p.start for p in start}}
    return FamilyFit(kind, "sticky", every, mean_square=mean_square, samples=100)


def test_pictures_decide_against_paths(filmed, seen):
    objective = objective_of(filmed, seen)
    fits = [fitted(objective, "newtonian", WRONG, 1e-6), fitted(objective, "neo_hookean", TRUE, 1e-2)]
    errors = image_losses(objective, fits)
    assert errors["neo_hookean"] < 0.5 * errors["newtonian"]
    assert [f.kind for f in rank_by_image_loss(fits, errors)] == ["neo_hookean", "newtonian"]


def test_without_pictures_paths_decide(filmed, seen):
    objective = objective_of(filmed, seen, pictures=0)
    fits = [fitted(objective, "newtonian", WRONG, 1e-6), fitted(objective, "neo_hookean", TRUE, 1e-2)]
    assert image_losses(objective, fits) == {}
    assert [f.kind for f in rank_by_image_loss(fits, {})] == ["newtonian", "neo_hookean"]


def test_what_diverges_comes_last(filmed, seen):
    objective = objective_of(filmed, seen)
    good = fitted(objective, "neo_hookean", TRUE, 1.0)
    wild = dataclasses.replace(good, kind="newtonian", values={**good.values, **WRONG, "velocity_x": float("nan")})
    errors = image_losses(objective, [wild, good])
    assert [f.kind for f in rank_by_image_loss([wild, good], errors)] == ["neo_hookean", "newtonian"]


@pytest.mark.parametrize(("rich", "first"), [(0.095, "simple"), (0.08, "rich")])
def test_a_law_with_more_parameters_must_be_nearer_by_a_tenth(rich, first):
    fits = [FamilyFit(kind, "sticky", dict.fromkeys("abcd"[:k], 0.0)) for kind, k in (("rich", 4), ("simple", 2))]
    assert rank_by_image_loss(fits, {"rich": rich, "simple": 0.1})[0].kind == first


def test_a_search_that_was_killed_goes_on_with_its_finalists(filmed, seen, tmp_path, monkeypatch):
    """A family that was fitted further may be farther from the pictures than before; no other takes its place."""
    checkpoint, gone_on, shift = Checkpoint(tmp_path / "identify.pt"), [], 0

    def fit(kind, *_, **__):
        names = list(shortlist.CONTINUUM_FAMILIES)
        return FamilyFit(kind, "sticky", {}, mean_square=float(1 + (names.index(kind) + shift) % len(names)), samples=9)

    def further(found, *_, **__):
        gone_on.append(found.kind)
        if len(gone_on) == stop:
            raise KeyboardInterrupt
        return dataclasses.replace(found, stage=FURTHER, mean_square=1e6)

    monkeypatch.setattr(shortlist, "fit_family", fit)
    monkeypatch.setattr(shortlist, "fit_further", further)
    objective = objective_of(scene(), seen)

    def shortlisted(kept):
        gone_on.clear()
        shortlist.fit_shortlist(objective, None, 1, False, kept, lambda *_: None, Workers())
        return list(gone_on)

    stop = 2
    with pytest.raises(KeyboardInterrupt):
        shortlisted(checkpoint)
    first, stop = list(gone_on), 0
    shift = 2
    assert shortlisted(checkpoint) == first
    assert shortlisted(Checkpoint(None)) != first
