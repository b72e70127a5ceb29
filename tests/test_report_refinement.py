"""The report's section on `masiv refine`, from refine.json and refine.npz alone."""

from __future__ import annotations

import numpy as np
import pytest
from refined_by_hand import ERRORS, document, fields, write

from masiv.errors import InputError
from masiv.report import plots
from masiv.report.page import Page
from masiv.report.sections.refinement import read_refined, refinement_section
from masiv.report.time_charts import residual_in_time


def section_of(run, up=None):
    page, refined = Page(""), read_refined(run)
    if refined is None:
        return None
    refinement_section(page, *refined, up)
    return "".join(page.parts)


def test_numbers_and_pictures_of_an_accepted_effect(tmp_path):
    write(tmp_path, document(), fields())
    section = section_of(tmp_path, np.array([0.0, 1.0, 0.0]))
    assert section.count("data:image/png;base64,") == 4  # two views, before and after
    assert section.count("data-chart") == 1
    shown = [
        "effect added: one of linear drag, quadratic drag",
        "0.7234",
        "0.0213",
        "81 %",
        "10.7 → 4.2",
        "40.2 → 13.1",
        "quadratic drag",
        "0.0345",
        "2.25",
        "acts: 0.2 %",
    ]
    markup = ["it &lt;cannot&gt; be", "slows &amp; slows"]  # text is never markup
    assert "0.625 of what finer grids change" in section
    assert [text for text in (*shown, "61", "12 to 15", "0.31", *markup) if text not in section] == []


def test_nothing_found(tmp_path):
    alone = {"fit": ERRORS["fit"], "validation": {}}
    found = document(accepted=[], candidates=[], rounds=[], next_experiment=None, before=alone, after=alone,
                     verdict="nothing missing", grid_change={"before": None, "after": None})  # fmt: skip
    write(tmp_path, found, fields(instants=12, fitted=12))
    section = section_of(tmp_path)
    assert "nothing missing" in section
    assert [text for text in ("What was added", "on validation", "Refits", "finer grids") if text in section] == []


def test_a_discrepancy_force_is_no_cause(tmp_path):
    force = {
        "effect": "smooth_force",
        "theta": {},
        "stderr": {},
        "unit": {},
        "fit_rmse_mm": 3.25,
        "validation_rmse_mm": 9.75,
        "test_rmse_mm": None,
        "share": {"fit": 0.876, "validation": 0.54, "test": None},
        "peak": None,
        "in_twin": False,
    }
    arrays = fields()
    places = np.tile(arrays["points@run"][:20], (16, 1, 1))
    places[3, :5] = np.nan  # hidden
    arrays |= {"force_places@run": places, "force@run": 0.5 + places**2}
    write(tmp_path, document(accepted=[], verdict="unexplained residual", discrepancy_force=force), arrays)
    section = section_of(tmp_path)
    shown = ("unexplained residual", "without a known cause", "3.25", "9.75 mm (validation)", "88 %", "54 %", "worse")
    assert [t for t in shown if t not in section] == []
    assert section.count("data:image/png;base64,") == 4  # two views of the residual, and of the force
    assert section.count("data-chart") == 2


def test_absent_and_unreadable(tmp_path):
    assert section_of(tmp_path) is None
    write(tmp_path, document(), fields())
    (tmp_path / "refine.npz").write_bytes(b"PK broken")
    with pytest.raises(InputError, match="run masiv refine again"):
        section_of(tmp_path)
    write(tmp_path, document(schema=1), fields())
    with pytest.raises(InputError, match="another version"):
        section_of(tmp_path)


def test_fields_of_one_instant_and_of_no_residual():
    """Pictures hold for what a short or a perfect fit gives."""
    one = np.zeros((1, 8, 3), dtype=np.float32)
    points = np.random.default_rng(1).uniform(size=(8, 3))
    for png, _ in plots.residual_in_space({"before": one}, points, np.array([0.1])):
        assert png.startswith(b"\x89PNG")
    chart = residual_in_time({"before": one}, np.array([0.1]), 1, 0, 1.0).data()
    assert chart["lines"][0]["y"] == [0.0]
    assert [band["name"] for band in chart["bands"]] == ["fitted"]
