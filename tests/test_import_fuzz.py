"""Damaged calibrations are read or refused with an InputError: nothing else comes out of their readers."""

from __future__ import annotations

import footage_files as made
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from masiv.errors import InputError
from masiv.footage.calibration import read_calibration
from masiv.footage.world_frame import read_landmarks


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Each file to damage, and what is read then."""
    root = tmp_path_factory.mktemp("calibrations")
    binary, text = made.colmap(root / "binary", binary=True), made.colmap(root / "text", binary=False)
    toml, transforms = made.toml(root / "c.toml"), made.transforms(root / "transforms.json")
    landmarks = root / "landmarks.yaml"
    landmarks.write_text("points: {a: {left: [1, 2], right: [3, 4]}, b: {left: [5, 6]}}\ndistances: [[a, b, 0.5]]\n")
    return [
        *((binary / name, binary) for name in ("cameras.bin", "images.bin")),
        *((text / name, text) for name in ("cameras.txt", "images.txt")),
        (toml, toml),
        (transforms, transforms),
        (landmarks, landmarks),
    ]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_an_input_error_or_harmless(files, data):
    path, read = data.draw(st.sampled_from(files))
    whole = path.read_bytes()
    start = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.integers(0, 12))
    put = data.draw(st.binary(max_size=12) | st.sampled_from([b"nan", b"-1", b"1e999", b"[", b'"', b"\n", b"9" * 400]))
    path.write_bytes(data.draw(st.sampled_from([whole[:start] + put + whole[start + length :], whole[:start]])))
    said = "read"
    try:
        (read_landmarks if path.suffix == ".yaml" else read_calibration)(read)
    except InputError as error:
        said = str(error)
    finally:
        path.write_bytes(whole)
    assert len(said.splitlines()) == 1
