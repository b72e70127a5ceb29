"""The answer to "what is this material?" as a section of the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv.errors import InputError
from masiv.refinement.answer import words
from masiv.report.quantities import quantity
from masiv.strict import read_json

if TYPE_CHECKING:
    from masiv.report.page import Page

MATERIAL = "material.json"


def read_material(run: Path) -> dict[str, Any] | None:
    """material.json of the run folder, or None where it has none. Raises InputError where it cannot be read."""
    path = run / MATERIAL
    if not path.is_file():
        return None
    try:
        data = read_json(path)
    except InputError as error:
        raise InputError(f"{path} cannot be read ({error}): delete it and run masiv identify again") from error
    if not isinstance(data, dict) or data.get("schema") != 1:
        raise InputError(f"{path} is of another version of masiv: delete it and run masiv identify again")
    return data


def material_section(page: Page, material: Mapping[str, Any]) -> None:
    """Add the section of ``material`` (the content of material.json) to ``page``."""
    from masiv.report.law_charts import material_charts

    page.heading("What is this material?")
    page.text(material["summary"])
    page.table(
        ["quantity", "value", "unit", "standard error [%]", "note"],
        [
            [name, _number(q["value"]), q["unit"], _number(q["stderr_percent"]), q["note"]]
            for name, q in material["quantities"].items()
        ],
    )
    page.charts(material_charts(material["curves"]))
    page.note(
        "Grey: strains that this motion did not show, where the law is a guess. Dashed: the nearest classical law."
    )
    page.table(
        ["classical law", "residual [%]", "its best parameters"],
        [[words(m["kind"]), _number(m["misfit_percent"]), _parameters(m["parameters"])] for m in material["families"]],
    )
    if material["sensitivities"]:
        page.table(
            ["10 % more of", "moves the body by [mm, RMS]", "excited", "standard error [%]"],
            [
                [s["name"], _number(s["moved_mm"]), s["excited"], _number(s["stderr_percent"])]
                for s in material["sensitivities"]
            ],
        )
        page.note(
            f"Against a fit's error of {material['error_mm']:.1f} mm. Excited: a tenth of that or more. Standard "
            "errors hold the initial state and the ground fixed; a dash: this motion does not determine it."
        )


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _parameters(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    return ", ".join(f"{words(n)} {quantity(v['value'], v['unit'])}" for n, v in parameters.items())
