"""What the search of causes tries again, and what it does not try."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from masiv.models.base import EffectTerm
from masiv.models.parameters import Parameter
from masiv.refine import add_effect, second_effect
from masiv.refine import search as loop
from masiv.refine.config import RefineConfig
from masiv.refine.rounds import Round, Trial
from masiv.workers import Workers

NUMBERS = {"ground_height": 1, "linear_drag": 1, "restitution": 1, "point_mass": 4, "body_force": 3}
KINKED = ("restitution",)
LAW = SimpleNamespace(kind="neo_hookean")


class Library:
    """Knows terms and nothing else."""

    observations = ()

    def term(self, name):
        own = tuple(Parameter(f"{name}.{k}", 0.0, 0.0, 1.0, 0.1) for k in range(NUMBERS[name]))
        return EffectTerm(name, name, own, (), ((),), {}, nonsmooth=name in KINKED)

    def candidates(self, model):
        return [n for n in NUMBERS if n not in model.effects]


def fit(*effects, cost=1.0):
    numbers = [None] * (9 + sum(NUMBERS[n] for n in effects))
    return SimpleNamespace(
        model=SimpleNamespace(family=LAW, effects=effects), cost=cost, parameters=numbers,
        samples=100, bic=lambda samples: cost,
    )  # fmt: skip


def trial(name, **changes):
    return Trial(SimpleNamespace(effect=name), fit(name, **changes))


@pytest.mark.parametrize(
    ("rival", "beside_rival"),
    [
        ("point_mass", {"linear_drag", "restitution"}),
        ("linear_drag", {"ground_height", "restitution"}),
    ],
)
def test_a_rival_of_many_numbers_is_not_tried_beside_the_accepted_cause(rival, beside_rival, monkeypatch):
    looked = {}

    def ranked(workers, simulation, base, *, robust_scale, names, progress):
        looked[base.model.effects] = set(names)
        return []

    monkeypatch.setattr(second_effect, "ranked", ranked)
    monkeypatch.setattr(second_effect, "warm_started_fit", lambda simulation, fitted, robust_scale: fitted)
    current = fit("ground_height")
    first = Round(current, [], [trial("ground_height"), trial(rival)], None, {})
    second_effect.search_second_effect(Library(), current, first, 1.0, RefineConfig(), lambda *_: None, Workers())
    assert looked == {("ground_height",): {"linear_drag", "restitution"} - {"ground_height"}, (rival,): beside_rival}


def test_what_is_simpler_or_has_a_kink_is_fitted_again_from_where_the_best_ended(monkeypatch):
    again = []

    def map_tasks(workers, simulation, function, tasks):
        for _, name, best, _ in tasks:
            again.append(name)
            assert best.model.effects == ("linear_drag",)
            yield fit(name, cost=0.5)

    monkeypatch.setattr(loop, "map_tasks", map_tasks)
    trials = [trial("linear_drag"), trial("ground_height", cost=2.0), trial("restitution", cost=2.0),
              trial("point_mass", cost=2.0)]  # fmt: skip
    loop._refit_simpler_candidates(Library(), trials, 1.0, lambda *_: None, Workers())
    assert again == ["restitution"]
    assert [t.fitted.cost for t in trials] == [1.0, 2.0, 0.5, 2.0]


@pytest.mark.parametrize(("log_predictive_gain", "first"), [(9.0, "neo_hookean"), (2.0, "von_mises")])
def test_residuals_are_weighed_by_the_law_that_foretells_the_motion(log_predictive_gain, first, monkeypatch):
    """A plastic law fits a viscous body's first frames best; whether it is the base, the frames after them say."""
    noise, with_residual_std = 1e-3, []

    def law(kind, fitted, held_out):
        found = fit(cost=fitted * noise**2)
        found.model = SimpleNamespace(family=SimpleNamespace(kind=kind), effects=())
        found.squares, found.values = [noise**2 * np.array([fitted, fitted, held_out])], {}
        return found

    baselines = [law("von_mises", 1.0, log_predictive_gain), law("neo_hookean", 1.9, 3.0)]
    simulation = Library()
    simulation.observations = (
        SimpleNamespace(residual_std=np.full(3, noise), noise_std=noise, fit_count=2, holds_out=True, time_count=3),
    )  # fmt: skip
    simulation.residual = lambda model, values: np.full(8, noise)
    monkeypatch.setattr(
        loop, "update_residual_std", lambda _, fitted, __: with_residual_std.append(fitted.model.family.kind)
    )
    monkeypatch.setattr(loop, "map_tasks", lambda *_: iter(baselines))
    rivals, _ = loop._weighed_baselines(simulation, baselines, [], RefineConfig(), lambda *_: None, Workers())
    assert [f.model.family.kind for f in rivals] == sorted(["neo_hookean", "von_mises"], key=lambda k: k != first)
    assert with_residual_std == (["von_mises"] if first == "von_mises" else ["von_mises", "neo_hookean"])


@pytest.mark.parametrize(
    ("best", "ends", "kept"),
    [
        (0.1, 0.12, 0.12),  # it was a minimum that was none
        (0.1, 1.5, 1.0),  # the cause did help
        (0.6, 0.1, 1.0),  # which is not asked where it helped little
    ],
)
def test_what_an_effect_helped_out_of_is_left_without_it(best, ends, kept, monkeypatch):
    reset_initial_conditions = []

    def gauss_newton_fit(simulation, model, values, **_):
        reset_initial_conditions.append(values)
        return fit("ground_height", cost=ends)

    monkeypatch.setattr(loop, "gauss_newton_fit", gauss_newton_fit)
    monkeypatch.setattr(loop, "held_in", lambda *_: frozenset())
    base, richer = fit("ground_height"), fit("ground_height", "point_mass", cost=best)
    base.values, richer.values = {"height": 0.1, "offset": 3.0}, {"height": 0.2, "mass": 5.0}
    assert loop._restart_base(Library(), base, richer, 1.0).cost == kept
    assert reset_initial_conditions == ([{"height": 0.2, "offset": 3.0}] if best < 0.5 else [])


@pytest.mark.parametrize(("left", "fitted"), [(1.1, ["0", "1"]), (1.3, ["0", "1", "2", "3"])])
def test_more_causes_are_fitted_while_much_is_left(left, fitted, monkeypatch):
    """A cause that acts at a place may be far down in a linear ranking: of five that explain something, in twos."""
    heard = []
    explained = {"0": 0.5, "1": 0.4, "2": 0.3, "3": 0.2, "4": 0.15, "5": 0.05}
    candidates = [SimpleNamespace(effect=name, explained=share) for name, share in explained.items()]

    def trials(simulation, curriculum, start, candidates, *_):
        heard.extend(c.effect for c in candidates)
        return [Trial(c, fit()) for c in candidates]

    monkeypatch.setattr(loop, "ranked", lambda *_, **__: candidates)
    monkeypatch.setattr(loop, "_trials", trials)
    monkeypatch.setattr(loop, "reduced_chi", lambda *_: left)
    monkeypatch.setattr(loop, "_refit_simpler_candidates", lambda *_: None)
    monkeypatch.setattr(loop, "confusable", lambda *_: {})
    monkeypatch.setattr(loop, "_reasons", lambda *_: ["none is meant"])
    simulation = Library()
    simulation.curriculum = lambda base: []
    base = fit(cost=2.0)
    done = loop._round(simulation, base, [base], 1.0, RefineConfig(shortlist=2), lambda *_: None, Workers())
    assert heard == fitted
    assert done.accepted is None


def test_a_cause_that_falls_short_of_its_promise_gets_fresh_derivatives(monkeypatch):
    base = SimpleNamespace(
        model=SimpleNamespace(with_effect=lambda name: name), values={}, cost=1.0, parameters=(), effects=()
    )  # fmt: skip
    candidate = SimpleNamespace(finite=False, effect="linear_drag", explained=0.8, rivals=(),
                                theta={"linear_drag.0": 0.3})  # fmt: skip
    ended = {"linear_drag.0": 1e-3}
    calls = []
    monkeypatch.setattr(add_effect, "held_in", lambda *_: frozenset())
    monkeypatch.setattr(add_effect, "_fitted_beside", lambda simulation, base, term: list(term.parameters))
    monkeypatch.setattr(add_effect, "_as_guessed", lambda *_: (0.95, ended, None, None))
    monkeypatch.setattr(add_effect, "best_strength", lambda *_: (None, 1.2))
    monkeypatch.setattr(
        add_effect, "gauss_newton_fit", lambda simulation, model, values, **_: calls.append(values) or "fresh"
    )
    monkeypatch.setattr(add_effect, "evaluate_fit", lambda *_, **__: "as it was")
    assert add_effect.refit(Library(), base, candidate, 1.0) == "fresh"
    assert calls == [ended]
    candidate.explained = 0.05
    assert add_effect.refit(Library(), base, candidate, 1.0) == "as it was"
