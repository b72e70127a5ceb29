"""Files of motion capture: positions, gaps, times and units as they were written, and what is refused."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_capture_files import fall, write_motive, write_qtm, write_trc

from masiv.errors import InputError
from masiv.tracks.read import read_tracks
from masiv.tracks.table import read_table

FORMATS = {
    "trc": ("one.trc", write_trc),
    "qtm": ("one.tsv", write_qtm),
    "qtm without columns": ("one.tsv", partial(write_qtm, columns=False)),
    "qtm with empty gaps": ("one.tsv", partial(write_qtm, columns=False, gap="")),
    "motive": ("one.csv", write_motive),
}
MARKERS = ["tip", "Body:base left"]


@pytest.mark.parametrize("name", FORMATS)
@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 12))
def test_what_was_written_is_read(tmp_path_factory, name, seed, count):
    file, write = FORMATS[name]
    path = tmp_path_factory.mktemp("capture") / file
    random = np.random.default_rng(seed)
    positions = random.normal(0, 500, (count, 2, 3))
    positions[random.random((count, 2)) < 0.3] = np.nan
    times = np.arange(count) / 120
    write(path, MARKERS, positions, times)
    table = read_table(path, None, {})
    assert table.markers == tuple(MARKERS)
    assert table.unit == "mm"
    assert table.rate == pytest.approx(120, rel=1e-3)
    np.testing.assert_allclose(table.times, times, atol=1e-5)
    np.testing.assert_allclose(table.positions, positions, atol=1e-5)


def test_the_same_fall_in_three_formats_is_the_same_scene(tmp_path):
    times = np.arange(30) / 120
    points = np.stack([fall(times), fall(times) + np.array([0, 50, 0])], axis=1)
    for file, write in (FORMATS["trc"], FORMATS["qtm"], FORMATS["motive"]):
        write(tmp_path / file, MARKERS, points, times)
    runs = [
        {"file": file, "name": file, "markers": {"side": MARKERS[1], "tip": "tip"}}
        for file, _ in (FORMATS["trc"], FORMATS["qtm"], FORMATS["motive"])
    ]
    scene = {"layout": "tracks", "bodies": {"ball": {"mass": 0.1}}, "runs": runs}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    tracks = read_tracks(tmp_path)
    for run in tracks.runs:
        assert run.markers == ("side", "tip")
        np.testing.assert_allclose(run.positions, 1e-3 * points[:, ::-1], atol=1e-7)
        # gravity of the written motion, 9.81 m/s², to the digits of the file
        assert np.polyfit(run.times, run.positions[:, 1, 2], 2)[0] == pytest.approx(-4.905, rel=1e-4)
    runs[0]["markers"] = {"a": "tip", "b": "tip"}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    with pytest.raises(InputError, match="a marker is named twice"):
        read_tracks(tmp_path)
    runs[0]["markers"] = {"a": "no such"}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    with pytest.raises(InputError, match=r"no marker 'no such' in one\.trc: it has tip, Body:base left"):
        read_tracks(tmp_path)


def rewritten(path, change):
    path.write_text(change(path.read_text(encoding="utf-8-sig")))
    with pytest.raises(InputError) as error:
        read_table(path, None, {})
    return str(error.value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("trc", lambda t: t.replace("Frame#", "Frames"), "no row that begins with Frame#"),
        ("trc", lambda t: "\n".join(t.splitlines()[:-2]), "its header says 5 frames, there are 3"),
        ("trc", lambda t: t.replace("\tBody:base left", "\ttip"), "two markers are named 'tip'"),
        ("trc", lambda t: t.replace("100.00\t100.00", "-5\t-5"), "its rate is -5 Hz"),
        ("trc", lambda t: t.replace("2000.00000", "high"), "row 7: 'high' is not a finite number"),
        ("trc", lambda t: t.replace("2000.00000\n", "2000.00000\t1\n"), "more than its 2 markers need"),
        ("qtm", lambda t: t.replace("MARKER_NAMES", "NAMES"), "no row MARKER_NAMES"),
        ("qtm", lambda t: t.replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t2D"), "export 3D data"),
        ("motive", lambda t: t.replace(",Type,", ",Kind,"), "lacks the rows Type and Name"),
        ("motive", lambda t: t.replace(",Marker", ",Bone"), "has no markers"),
        ("motive", lambda t: "\n".join(t.splitlines()[:7]), "no rows of data"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(tmp_path, name, change, message):
    file, write = FORMATS[name]
    times = np.arange(5) / 100
    write(tmp_path / file, MARKERS, np.stack([fall(times), fall(times)], axis=1), times)
    said = rewritten(tmp_path / file, change)
    assert message in said
    assert "\n" not in said


def test_columns_of_motion_capture_are_not_declared(tmp_path):
    times = np.arange(5) / 100
    write_trc(tmp_path / "one.trc", MARKERS, np.stack([fall(times), fall(times)], axis=1), times)
    with pytest.raises(InputError, match="leave out columns and select"):
        read_table(tmp_path / "one.trc", None, {"trial": 1})
