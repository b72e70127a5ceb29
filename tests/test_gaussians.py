"""The PLY of Gaussians: round trip, the layout that viewers expect, and clear errors."""

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from plyfile import PlyData, PlyElement

from masiv.errors import InputError, MasivError
from masiv.splat.gaussians import Gaussians


def floats(low, high):
    return st.floats(low, high, width=32)


@st.composite
def gaussians(draw):
    count = draw(st.integers(0, 12))
    parts = [
        draw(hnp.arrays(np.float32, (count, 3), elements=floats(-100.0, 100.0))),
        draw(hnp.arrays(np.float32, (count,), elements=floats(2.0**-20, 8.0))),
        draw(hnp.arrays(np.float32, (count,), elements=floats(0.0, 1.0))),
        draw(hnp.arrays(np.float32, (count, 3), elements=floats(0.0, 1.0))),
    ]
    return Gaussians(*(torch.from_numpy(p) for p in parts))


@settings(max_examples=60, deadline=None)
@given(gaussians())
def test_round_trip(original):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gaussians.ply"
        original.save_ply(path)
        again = Gaussians.load_ply(path)
        assert [p.name for p in Path(folder).iterdir()] == ["gaussians.ply"]
    torch.testing.assert_close(again.means, original.means, rtol=0, atol=0)
    torch.testing.assert_close(again.scales, original.scales, rtol=3e-6, atol=0)
    torch.testing.assert_close(again.opacities, original.opacities, rtol=0, atol=2e-6)
    torch.testing.assert_close(again.colours, original.colours, rtol=0, atol=1e-6)


def one(**changes):
    parts = {
        "means": torch.tensor([[1.0, 2.0, 3.0]]),
        "scales": torch.tensor([0.5]),
        "opacities": torch.tensor([0.8]),
        "colours": torch.tensor([[0.5, 1.0, 0.0]]),
    }
    return Gaussians(**{**parts, **changes})


def test_layout_of_the_file(tmp_path):
    one().save_ply(tmp_path / "g.ply")
    ply = PlyData.read(str(tmp_path / "g.ply"))
    row = ply["vertex"].data[0]
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    assert list(ply["vertex"].data.dtype.names) == names
    assert not ply.text
    assert row["opacity"] == pytest.approx(math.log(4), rel=1e-6)
    assert row["scale_2"] == pytest.approx(math.log(0.5), rel=1e-6)
    assert row["f_dc_1"] == pytest.approx(math.sqrt(math.pi), rel=1e-6)
    assert [row[f"rot_{i}"] for i in range(4)] == [1, 0, 0, 0]


def test_non_finite_is_not_written(tmp_path):
    with pytest.raises(MasivError, match="scale_0 is not finite"):
        one(scales=torch.tensor([0.0])).save_ply(tmp_path / "g.ply")
    with pytest.raises(MasivError, match="y is not finite"):
        one(means=torch.tensor([[0.0, float("nan"), 0.0]])).save_ply(tmp_path / "g.ply")
    assert list(tmp_path.iterdir()) == []


def test_bad_files(tmp_path):
    with pytest.raises(InputError, match=r"missing\.ply is not a PLY file of Gaussians"):
        Gaussians.load_ply(tmp_path / "missing.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nnonsense\n")
    with pytest.raises(InputError, match="not a PLY file"):
        Gaussians.load_ply(tmp_path / "bad.ply")
    rows = np.zeros(2, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "cloud.ply"))
    with pytest.raises(InputError, match="not a PLY file of Gaussians"):
        Gaussians.load_ply(tmp_path / "cloud.ply")
    one().save_ply(tmp_path / "g.ply")
    whole = (tmp_path / "g.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-5])
    with pytest.raises(InputError, match="not a PLY file"):
        Gaussians.load_ply(tmp_path / "cut.ply")
    rows = PlyData.read(str(tmp_path / "g.ply"))["vertex"].data.copy()
    rows["scale_1"] += 1
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "long.ply"))
    with pytest.raises(InputError, match="anisotropic"):
        Gaussians.load_ply(tmp_path / "long.ply")
