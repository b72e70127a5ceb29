"""Steps of a training that go too far are halved or undone, and a restored training goes on as the first one would."""

import torch
from cube import settings

from masiv.errors import NonFiniteError
from masiv.identification.neural.training_state import LR_RECOVERY, MAX_FAILURES, TrainingState
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState

RESOLUTION = 1e-3


def training(seed=0):
    """A training of a small law, and its initial state, whose velocity has a gradient."""
    state = InitialState(torch.zeros(3), torch.zeros(3), torch.zeros(()))
    for tensor in state.tensors():
        tensor.requires_grad_()
    made = TrainingState(NeuralLaw(width=4, seed=seed), [state], settings(), 10)
    made.schedule(0.0)
    state.velocity.grad = torch.tensor([1.0, 0.0, 0.0])
    return made, state


def errors(*values):
    return [torch.tensor(values)]


def test_a_step_that_doubles_the_distance_is_halved_until_it_is_not():
    made, state = training()
    made.step(errors(0.01, 0.01))
    whole = state.velocity.detach().clone()
    assert whole[0] < 0  # against the gradient
    assert made.is_worse(errors(0.03, 0.02), RESOLUTION)
    assert not made.is_worse(errors(0.01, 0.02), RESOLUTION)
    made.halve_step()
    torch.testing.assert_close(state.velocity.detach(), whole / 2)
    made.halve_step()
    torch.testing.assert_close(state.velocity.detach(), whole / 4)
    made.schedule(0.0)
    assert made.state()["optimizer"]["param_groups"][2]["lr"] == settings().velocity_learning_rate / 4
    made.step(errors(0.01, 0.01))
    made.schedule(0.0)
    assert made.state()["optimizer"]["param_groups"][2]["lr"] == settings().velocity_learning_rate / 4 * LR_RECOVERY


def test_distances_are_compared_at_the_instants_that_both_have():
    made, _ = training()
    made.step(errors(0.01, 0.01))
    assert not made.is_worse(errors(0.01, 0.01, 0.5), RESOLUTION)  # the horizon grew
    assert not made.is_worse(errors(0.01), RESOLUTION)
    assert made.is_worse(errors(0.03), RESOLUTION)


def test_distances_below_the_resolution_are_no_reason_to_halve_a_step():
    made, _ = training()
    made.step(errors(1e-5))
    assert not made.is_worse(errors(1.9 * RESOLUTION), RESOLUTION)
    assert made.is_worse(errors(2.1 * RESOLUTION), RESOLUTION)


def test_a_step_that_stays_worse_is_accepted_in_the_end():
    made, _ = training()
    made.step(errors(0.01))
    for _ in range(MAX_FAILURES):
        assert made.is_worse(errors(1.0), RESOLUTION)
        made.halve_step()
    assert not made.is_worse(errors(1.0), RESOLUTION)


def test_a_restored_training_undoes_a_step_to_what_was_accepted():
    made, state = training()
    made.step(errors(0.01))
    stepped = state.velocity.detach().clone()
    restored, other = training(seed=1)
    restored.restore(made.state())
    torch.testing.assert_close(other.velocity.detach(), stepped)
    assert restored.is_worse(errors(0.03), RESOLUTION)
    restored.back_off(5, NonFiniteError(1, 0, "a test"))
    torch.testing.assert_close(other.velocity.detach(), torch.zeros(3))
    assert restored.horizon == 4
