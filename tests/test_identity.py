"""Content hashes: what tells scenes apart, and rollouts that are kept."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from masiv.models import cache
from masiv.models.cache import RolloutCache
from masiv.observations.identity import content_hash, identity
from masiv.scene.scene import Ground
from masiv.tracks.geometry import Geometry
from masiv.tracks.placement import Placement
from masiv.tracks.read import read_tracks

BAR = Path(__file__).parent / "golden" / "bar"


@pytest.fixture(scope="module")
def bar():
    return read_tracks(BAR)


def with_body(tracks, **changes):
    (name,) = tracks.bodies
    return replace(tracks, bodies={name: replace(tracks.bodies[name], **changes)})


def with_run(tracks, **changes):
    return replace(tracks, runs=(replace(tracks.runs[0], **changes), *tracks.runs[1:]))


def smaller(geometry: Geometry) -> Geometry:
    return replace(geometry, lower=0.9 * geometry.lower, upper=0.9 * geometry.upper)


CHANGES = {
    "density": lambda t: with_body(t, density=2140.0),
    "mass": lambda t: with_body(t, mass=1.0),
    "Poisson's ratio": lambda t: with_body(t, poissons_ratio=0.3),
    "geometry": lambda t: with_body(t, geometry=smaller(t.bodies["bar"].geometry)),
    "clamp": lambda t: with_body(t, clamps=(replace(t.bodies["bar"].clamps[0], heights=np.array([-0.04])),)),
    "clamped markers": lambda t: with_body(t, clamps=(replace(t.bodies["bar"].clamps[0], markers=()),)),
    "no clamp": lambda t: with_body(t, clamps=()),
    "two clamps": lambda t: with_body(t, clamps=(*t.bodies["bar"].clamps, t.bodies["bar"].clamps[0])),
    "group": lambda t: with_body(t, group="other"),
    "placement": lambda t: with_run(t, placement=Placement(np.eye(3), np.array([0.0, 0.0, 0.06]))),
    "release": lambda t: with_run(t, release=0.11),
    "condition": lambda t: with_run(t, condition="warm"),
    "purpose": lambda t: with_run(t, purpose="hold_out"),
    "positions": lambda t: with_run(t, positions=t.runs[0].positions + 1e-6),
    "times": lambda t: with_run(t, times=t.runs[0].times + 1e-6),
    "gravity": lambda t: replace(t, gravity=t.gravity * 1.001),
    "up": lambda t: replace(t, up=np.array([0.0, 1.0, 0.0])),
    "ground": lambda t: replace(t, ground=Ground(np.array([1.0, 0, 0]), -1.0)),
    "medium": lambda t: replace(t, medium_density=1000.0),
    "viscosity": lambda t: replace(t, medium_viscosity=1e-3),
}


@pytest.mark.parametrize("what", CHANGES)
def test_whatever_matters_changes_the_identity_of_tracks(bar, what):
    assert identity(CHANGES[what](bar)) != identity(bar)


def test_the_folder_of_tracks_does_not_matter(bar, tmp_path):
    shutil.copytree(BAR, tmp_path / "elsewhere")
    assert identity(read_tracks(tmp_path / "elsewhere")) == identity(bar)


@dataclass(frozen=True)
class Pair:
    first: object
    second: object


def test_a_content_hash_is_of_the_values():
    array = np.arange(6.0).reshape(2, 3)
    same = [{"a": (1, 2.0, None, "b", array)}, {"a": [1, np.float64(2.0), None, "b", array.copy(order="F")]}]
    assert content_hash(same[0]) == content_hash(same[1])
    assert content_hash(torch.from_numpy(array)) == content_hash(array)
    assert content_hash(Pair(1, array)) == content_hash(Pair(1, array.copy()))
    different = [
        1, 1.0, True, "1", b"1", None, [1], [[1]], [1, 1], {1: 1}, array, array.reshape(3, 2), array.astype(np.float32),
        -0.0, np.nextafter(1.0, 2.0), slice(1), Pair(1, 2), Pair(2, 1), [1, [2, 3]], [[1, 2], 3],
    ]  # fmt: skip
    assert len({content_hash(value) for value in different}) == len(different)
    with pytest.raises(TypeError, match="a value of type object"):
        content_hash([object()])


def test_rounded_numbers_have_one_hash():
    assert content_hash([1e-3, np.array([0.1, -0.0])], 9) == content_hash([1e-3 * (1 + 1e-13), np.array([0.1, 0.0])], 9)
    assert content_hash(1e-3, 9) != content_hash(1.00001e-3, 9)


def counted(values):
    """Arrays that are computed, and how often."""
    calls = []

    def compute():
        calls.append(1)
        return {"markers": np.asarray(values, dtype=float)}

    return compute, calls


def test_rollouts_are_kept_in_memory_and_the_oldest_goes_first():
    kept = RolloutCache(2)
    compute, calls = counted([1, 2])
    for key in ("a", "b", "a", "c", "b", "a"):
        np.testing.assert_array_equal(kept.get(key, compute)["markers"], [1, 2])
    assert len(calls) == 4  # a, b, c, and a again


def test_rollouts_are_kept_on_disk_for_the_code_that_made_them(tmp_path, monkeypatch):
    compute, calls = counted([[1.5, 2.5]])
    for _ in range(2):  # another process, with a memory of its own
        found = RolloutCache(2, tmp_path).get(("body", 1.0), compute)
        np.testing.assert_array_equal(found["markers"], [[1.5, 2.5]])
    assert len(calls) == 1
    RolloutCache(2, tmp_path).get(("body", 2.0), compute)
    monkeypatch.setattr(cache, "code_digest", lambda: "of another version")
    RolloutCache(2, tmp_path).get(("body", 1.0), compute)
    assert len(calls) == 3
    assert len(list(tmp_path.iterdir())) == 3
