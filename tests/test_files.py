"""Files are written completely or not at all."""

import json
import math

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file

from masiv.checkpoint import Checkpoint
from masiv.files import atomic, write_bytes, write_json, write_npz, write_safetensors, write_text, write_yaml


class Unreadable:
    """An array that cannot be converted, so that its writer fails midway."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("disk full")


def write_half(path, interruption):
    with atomic(path) as temporary:
        temporary.write_text("half")
        raise interruption


def test_what_is_written_is_read_back(tmp_path):
    folder = tmp_path / "new" / "folder"
    write_bytes(folder / "a.bin", b"\x00\xff")
    write_text(folder / "a.txt", "3 µm")
    write_yaml(folder / "a.yaml", {"z": 1, "a": [2.0]})
    write_npz(folder / "a.npz", **{"times@run": np.arange(3)})
    write_npz(folder / "plain.npz", compressed=False, x=np.arange(3))
    write_safetensors(folder / "a.safetensors", {"x": torch.arange(6).reshape(2, 3).T}, {"kind": "neo_hookean"})
    assert (folder / "a.bin").read_bytes() == b"\x00\xff"
    assert (folder / "a.txt").read_text(encoding="utf-8") == "3 µm"
    assert list(yaml.safe_load((folder / "a.yaml").read_text())) == ["z", "a"]
    with np.load(folder / "a.npz") as archive:
        np.testing.assert_array_equal(archive["times@run"], np.arange(3))
    assert load_file(folder / "a.safetensors")["x"].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert len(list(folder.iterdir())) == 6


def test_json_is_strict(tmp_path):
    write_json(tmp_path / "a.json", {"psnr": math.inf, "n": np.float32(2), "v": np.arange(2), "p": tmp_path})
    assert json.loads((tmp_path / "a.json").read_text()) == {"psnr": None, "n": 2, "v": [0, 1], "p": str(tmp_path)}


@pytest.mark.parametrize("interruption", [RuntimeError, KeyboardInterrupt])
def test_a_writer_that_fails_leaves_nothing(tmp_path, interruption):
    with pytest.raises(interruption):
        write_half(tmp_path / "a.txt", interruption)
    with pytest.raises(RuntimeError, match="disk full"):
        write_npz(tmp_path / "a.npz", first=np.zeros(1000), second=Unreadable())
    assert list(tmp_path.iterdir()) == []


def test_a_writer_that_fails_keeps_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "a.txt", RuntimeError)
    with pytest.raises(TypeError):
        Checkpoint(tmp_path / "state.pt").save({"a": torch.zeros(3), "b": (value for value in range(3))})
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_the_temporary_name_is_in_the_same_folder_and_keeps_the_suffix(tmp_path):
    with atomic(tmp_path / "film.mp4") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".mp4"
        temporary.write_bytes(b"1")
        assert not (tmp_path / "film.mp4").exists()
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]
