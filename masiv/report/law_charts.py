"""Charts of a law: stress over strain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from masiv.report.charts import BLUE, GREY, ORANGE, Chart, Line

STRESS = "Kirchhoff stress [kPa]"


def law_charts(law: Any) -> list[Chart]:
    """Kirchhoff stress [kPa] of a ``masiv.materials.law.Law`` in uniaxial stretch, in shear and under volume change."""
    import torch

    amount = torch.linspace(-0.25, 0.25, 51, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).repeat(len(amount), 1, 1)
    stretch, shear, volume = eye.clone(), eye.clone(), eye * (1 + amount)[:, None, None] ** (1 / 3)
    stretch[:, 0, 0] += amount
    shear[:, 0, 1] += amount
    panels = (
        ("Stretch of one axis, others held", "stretch − 1", stretch, (0, 0)),
        ("Simple shear", "shear", shear, (0, 1)),
        ("Change of volume", "J − 1", volume, (0, 0)),
    )
    kind = next((parameter.dtype for parameter in law.parameters()), torch.float64)
    charts = []
    for title, label, gradients, (row, column) in panels:
        with torch.no_grad():
            stress = law.stress(gradients.to(kind))[:, row, column].double().numpy() / 1e3
        charts.append(Chart(title, label, STRESS, [Line("law", amount.numpy(), stress, listed=False)]))
    return charts


def material_charts(curves: Mapping[str, Mapping[str, Any]]) -> list[Chart]:
    """One chart for each curve of ``describe.Material``; grey beyond the observed range."""
    charts = []
    for name, curve in curves.items():
        strain, stress = np.asarray(curve["strain"]), np.asarray(curve["stress_pa"]) / 1e3
        low, high = curve["observed"]
        seen = np.where((strain >= low) & (strain <= high), stress, np.nan)
        lines = [
            Line("beyond what was seen", strain, stress, GREY),
            Line("identified, strains that were seen", strain, seen, BLUE),
        ]
        if curve["family_pa"] is not None:
            lines.append(Line("nearest classical law", strain, np.asarray(curve["family_pa"]) / 1e3, ORANGE, "dash"))
        charts.append(Chart(name[:1].upper() + name[1:], "strain", STRESS, lines))
    return charts
