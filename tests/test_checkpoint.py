"""States of a stage that is done in parts."""

from __future__ import annotations

import torch

from masiv.checkpoint import Checkpoint, NestedCheckpoint


def test_a_nested_state_holds_the_results_of_earlier_parts(tmp_path):
    stage = Checkpoint(tmp_path / "stage.pt", every_s=0.0)
    part = NestedCheckpoint(stage, {"first": torch.ones(2)})
    inner = NestedCheckpoint(part, {"second": 2})
    inner.maybe_save(lambda: {"step": 3})
    state = stage.load()
    assert state is not None
    assert state.keys() == {"first", "second", "step"}
    assert torch.equal(state["first"], torch.ones(2))
    part.save({})
    assert inner.load() is not None
    assert inner.load().keys() == {"first"}


def test_a_saved_key_takes_the_place_of_a_fixed_one(tmp_path):
    """As when a part is resumed and everything that was saved is fixed."""
    stage = Checkpoint(tmp_path / "stage.pt")
    stage.save({"base": 1, "fit": 2})
    NestedCheckpoint(stage, stage.load() or {}).save({"fit": 3})
    assert stage.load() == {"base": 1, "fit": 3}


def test_without_a_path_nothing_is_kept():
    part = NestedCheckpoint(Checkpoint(None, every_s=0.0), {"first": 1})
    part.maybe_save(lambda: {"step": 1})
    part.save({"step": 2})
    assert part.load() is None


def test_parts_that_run_beside_each_other_have_states_of_their_own_until_the_stage_is_done(tmp_path):
    stage = Checkpoint(tmp_path / "stage.pt")
    other = Checkpoint(tmp_path / "stage_two.pt")
    for checkpoint, value in ((stage, 1), (stage.part("start-2"), 2), (other, 3)):
        checkpoint.save({"value": value})
    assert [c.load() for c in (stage, stage.part("start-2"), other)] == [{"value": v} for v in (1, 2, 3)]
    stage.clear()
    assert stage.load() is None
    assert stage.part("start-2").load() is None
    assert other.load() == {"value": 3}
    assert Checkpoint(None).part("start-2").path is None
