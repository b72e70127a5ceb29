"""A law as the material of Newton's implicit MPM solver.

Newton 1.8: stress linear in the logarithmic strain (Young's modulus, Poisson's ratio); yield where sqrt(J2) exceeds
``yield_stress`` + ``friction`` p, with J2 = s : s / 2 of the deviatoric stress s and p the pressure; above it s grows
by 2 ``viscosity`` times the rate of plastic strain. A ``tensile_yield_ratio`` of 0 carries no tension.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from masiv.materials.classical import ClassicalLaw

if TYPE_CHECKING:
    from masiv.materials.law import Law

NEVER = 1e15
"""Yield stress [Pa] of what does not yield, as in Newton's defaults."""
FLUID_SHEAR = 1e-3
"""Shear over bulk modulus below which a material is a fluid: it then yields at once, and its shear modulus is free."""
FREE_POISSON = 0.3
"""Poisson's ratio that stands for the free shear modulus of a fluid; the bulk modulus is kept."""


def newton_material(law: Law, quantities: Mapping[str, Any] | None = None) -> tuple[dict[str, float], list[str]]:
    """Newton's parameters of ``law`` by name, SI units, and sentences about what they leave out.

    quantities: those of material.json, which give the strength of a law that is not classical (None: it is elastic).
    """
    values: dict[str, float] = {}
    if isinstance(law, ClassicalLaw):
        values = {name: float(value.detach()) for name, value in law.values.items()}
    if law.kind == "neo_hookean":
        note = "law neo_hookean: stress is linear in the logarithmic strain here; both agree for small strains"
        return elastic(*_moduli(law)), [note]
    if law.kind == "water":
        note = "law water: pressure is linear in ln J here, and tension is not carried"
        return fluid(_moduli(law)[1], 0.0), [note]
    if law.kind == "newtonian":
        note = "law newtonian: pressure is linear in ln J here, and tension is not carried"
        return fluid(values["bulk_modulus"], values["viscosity"]), [note]
    if law.kind == "von_mises":
        return elastic(*_moduli(law)) | {"yield_stress": values["yield_stress"] / math.sqrt(2)}, []
    if law.kind == "non_newtonian":
        made = elastic(*_moduli(law)) | {"yield_stress": values["yield_stress"] / math.sqrt(2)}
        return made | {"viscosity": values["plastic_viscosity"]}, []
    if law.kind == "drucker_prager":
        return granular(*_moduli(law), values["friction_angle"]), []
    if law.kind == "springs":
        note = "law springs: an elastic continuum with Poisson's ratio 1/4 in place of springs, without their dampers"
        return elastic(*_moduli(law)), [note]
    return _of_quantities(law, quantities)


def elastic(shear: float, bulk: float) -> dict[str, float]:
    """A solid that does not yield; shear and bulk modulus [Pa]."""
    return {
        "young_modulus": 9 * bulk * shear / (3 * bulk + shear),
        "poisson_ratio": (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear)),
        "yield_stress": NEVER,
        "friction": 0.0,
        "tensile_yield_ratio": 1.0,
        "viscosity": 0.0,
    }


def fluid(bulk: float, viscosity: float) -> dict[str, float]:
    """Bulk modulus [Pa], viscosity [Pa s]; no strength, no tension."""
    free = elastic(1.5 * bulk * (1 - 2 * FREE_POISSON) / (1 + FREE_POISSON), bulk)
    return free | {"yield_stress": 0.0, "tensile_yield_ratio": 0.0, "viscosity": viscosity}


def granular(shear: float, bulk: float, friction_angle: float) -> dict[str, float]:
    """Moduli [Pa]; the friction angle [deg] of the cone that touches Mohr–Coulomb's in compression."""
    sine = math.sin(math.radians(friction_angle))
    # |s| <= 3 alpha p, alpha as in masiv.kernels.laws.drucker_prager, and sqrt(J2) = |s| / sqrt(2)
    friction = 3 / math.sqrt(2) * math.sqrt(2 / 3) * 2 * sine / (3 - sine)
    return elastic(shear, bulk) | {"yield_stress": 0.0, "friction": friction, "tensile_yield_ratio": 0.0}


def _moduli(law: Law) -> tuple[float, float]:
    from masiv.characterization.curves import moduli_at_rest

    return moduli_at_rest(law)


def _of_quantities(law: Law, quantities: Mapping[str, Any] | None) -> tuple[dict[str, float], list[str]]:
    """A law that is not classical: its moduli at rest, and the strength that a tester would measure."""
    shear, bulk = _moduli(law)
    notes = [f"law {law.kind}: stress is linear in the logarithmic strain here, with the moduli at rest"]
    given = {name: row.get("value") for name, row in (quantities or {}).items()}
    viscosity = given.get("viscosity") or 0.0
    if viscosity:
        notes.append("the viscosity is that at the strain rate of the observed motion")
    if given.get("friction angle") is not None:
        return granular(shear, bulk, given["friction angle"]), notes
    strength = given.get("yield stress")
    if shear < FLUID_SHEAR * bulk or strength == 0:
        return fluid(bulk, viscosity), [*notes, "tension is not carried"]
    if strength is None:
        missing = "" if quantities else " (no material.json says how strong it is)"
        return elastic(shear, bulk), [*notes, f"it does not yield here{missing}"]
    notes.append("the yield stress is that at 0.2 % permanent axial strain; hardening is left out")
    return elastic(shear, bulk) | {"yield_stress": strength / math.sqrt(3), "viscosity": viscosity}, notes
