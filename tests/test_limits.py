"""Upper limits of effects whose place or frequency is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_model import ONES, TIMES, LinearModel, baseline, pattern

from masiv.errors import NonFiniteError
from masiv.inference.evidence import Evidence
from masiv.inference.linear_model import linear_model
from masiv.models.base import EffectTerm
from masiv.models.parameters import Parameter
from masiv.refinement.limits import FREQUENCIES, places_to_limit, sensitivities, upper_limit

NAME, STRENGTH, FREQUENCY = "periodic_force", "periodic_force.strength", "periodic_force.frequency"


class Shaken(LinearModel):
    """Points that a force of one frequency may shake along x."""

    diverges_above = np.inf

    def motion(self, values):
        rate = 2 * np.pi * values.get(FREQUENCY, 2.0)
        shaken = pattern(0, (np.cos(rate * TIMES) - 1) / rate**2, ONES)
        return pattern(2, TIMES, values.get("velocity_z", 0.0) * ONES) + values.get(STRENGTH, 0.0) * shaken

    def term(self, name):
        strength = Parameter(STRENGTH, 0.0, -50.0, 50.0, 0.1)
        frequency = Parameter(FREQUENCY, 2.0, 0.05, 200.0, 0.1)
        return EffectTerm(name, name, (strength,), (frequency,), ((2.0,),), {STRENGTH: "m/s^2", FREQUENCY: "Hz"})

    def fields(self, model, values, *, held_out=False):
        if values.get(STRENGTH, 0.0) != 0.0 and values.get(FREQUENCY, 0.0) > self.diverges_above:
            raise NonFiniteError(3, 4, "too fast")
        return super().fields(model, values, held_out=held_out)


def limit(model, places):
    fit = baseline(model)
    line = linear_model(model, fit.model, fit.values, fit.parameters)
    evidence = Evidence.of(model.observations, line.fields)
    found = sensitivities(model, line, NAME, places)
    return upper_limit(evidence, line, [], model.term(NAME), evidence.marginal(line, []), found)


@pytest.fixture(scope="module")
def model():
    return Shaken({"velocity_z": 0.5}, effects={NAME: None})


def test_frequencies_are_even_over_what_the_record_could_show(model):
    places = places_to_limit(model.term(NAME), {FREQUENCY: 2.0}, model.observations)
    assert places[0] == {FREQUENCY: 2.0}
    frequencies = [place[FREQUENCY] for place in places[1:]]
    assert len(frequencies) == FREQUENCIES
    duration, interval = TIMES[-1], TIMES[1]
    np.testing.assert_allclose(np.diff(frequencies), (0.5 / interval - 1 / duration) / FREQUENCIES)
    assert np.mean(frequencies) == pytest.approx((0.5 / interval + 1 / duration) / 2)


def test_places_are_the_guesses_and_an_abrupt_effect_has_one(model):
    term = replace(model.term(NAME), units={STRENGTH: "kg", FREQUENCY: "m"}, guesses=((0.1,), (0.2,)))
    assert places_to_limit(term, {FREQUENCY: 0.3}, []) == [{FREQUENCY: 0.3}, {FREQUENCY: 0.1}, {FREQUENCY: 0.2}]
    assert places_to_limit(term, {STRENGTH: 3.0, FREQUENCY: 0.2}, []) == [{FREQUENCY: 0.2}, {FREQUENCY: 0.1}]
    assert places_to_limit(replace(term, nonsmooth=True), {FREQUENCY: 0.3}, []) == [{FREQUENCY: 0.3}]


def test_a_force_of_unknown_frequency_may_be_stronger_than_at_the_frequency_where_it_shows_most(model):
    """A force of a high frequency moves a body little: the limit of all frequencies is far above that of a low one, and
    none of those that are possible is much higher."""
    places = places_to_limit(model.term(NAME), {FREQUENCY: 2.0}, model.observations)
    each = [limit(model, [place]).strength for place in places]
    assert each[:-2] == sorted(each[:-2])  # near two instants a period the phase counts, too
    assert max(each) > 20 * each[0]
    assert np.median(each) < limit(model, places).strength < 1.05 * max(each)


def test_one_place_alone_is_limited_as_before(model):
    one = limit(model, [{FREQUENCY: 2.0}])
    assert limit(model, [{FREQUENCY: 2.0}] * 3).strength == pytest.approx(one.strength)
    assert one.motion_mm < 1.0


def test_a_place_at_which_a_rollout_diverges_is_left_out(model):
    places = places_to_limit(model.term(NAME), {FREQUENCY: 2.0}, model.observations)
    frail = Shaken({"velocity_z": 0.5}, effects={NAME: None})
    frail.diverges_above = 10.0
    known = [place for place in places if place[FREQUENCY] < 10.0]
    assert 1 < len(known) < len(places)
    assert limit(frail, places).strength == pytest.approx(limit(model, known).strength)
    frail.diverges_above = 1.0
    with pytest.raises(NonFiniteError, match="diverges on both sides"):
        limit(frail, places)
