"""The classical families of laws that can be fitted: their parameters, and where a search starts.

The five of PAC-NeRF (Li et al. 2023) and GIC (Cai et al. 2024), and the springs of Spring-Gaus (Zhong et al. 2024).
Values are for 1000 kg/m^3: what moves a body is a modulus over its density.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

from masiv.materials.classical import CONTINUUM, UNITS, ClassicalLaw
from masiv.models.parameters import Parameter

MODULUS = Parameter("youngs_modulus", 3e4, 3e2, 1e7, 0.05, log=True)
RATIO = Parameter("poissons_ratio", 0.3, 0.0, 0.48, 0.01)
YIELD = Parameter("yield_stress", 1e3, 3.0, 1e6, 0.05, log=True)


@dataclass(frozen=True)
class Family:
    """parameters of a ``ClassicalLaw``; search: the values of some of them that a coarse search tries, in all
    combinations."""

    kind: str
    parameters: tuple[Parameter, ...]
    search: dict[str, tuple[float, ...]]

    def scaled(self, density: float) -> Family:
        """For a body of ``density`` [kg/m^3]: stresses and viscosities in proportion."""
        share = density / 1000

        def factor(name: str) -> float:
            return share if UNITS[name].startswith("Pa") else 1.0

        parameters = tuple(
            replace(p, **{f: getattr(p, f) * factor(p.name) for f in ("start", "lower", "upper")})
            for p in self.parameters
        )
        return Family(self.kind, parameters, {n: tuple(v * factor(n) for v in vs) for n, vs in self.search.items()})

    def candidates(self) -> list[dict[str, float]]:
        """The values that a coarse search tries."""
        start = {p.name: p.start for p in self.parameters}
        return [
            {**start, **dict(zip(self.search, chosen, strict=True))}
            for chosen in itertools.product(*self.search.values())
        ]


FAMILIES = {
    family.kind: family
    for family in (
        Family("neo_hookean", (MODULUS, RATIO), {"youngs_modulus": (3e3, 1e4, 3e4, 1e5, 3e5)}),
        Family(
            "newtonian",
            (
                Parameter("viscosity", 30.0, 0.05, 1e4, 0.1, log=True),
                Parameter("bulk_modulus", 2e5, 5e3, 3e6, 0.1, log=True),
            ),
            {"viscosity": (3.0, 30.0, 300.0), "bulk_modulus": (4e4, 3e5)},
        ),
        Family(
            "von_mises",
            (MODULUS, RATIO, YIELD),
            {"youngs_modulus": (3e4, 1e5, 3e5), "yield_stress": (3e2, 1e3, 3e3, 1e4)},
        ),
        Family(
            "non_newtonian",
            (
                Parameter("shear_modulus", 1e4, 3e2, 1e6, 0.05, log=True),
                Parameter("bulk_modulus", 5e4, 3e3, 3e6, 0.1, log=True),
                YIELD,
                Parameter("plastic_viscosity", 20.0, 0.05, 1e4, 0.1, log=True),
            ),
            {"shear_modulus": (3e3, 1e4, 4e4), "yield_stress": (30.0, 200.0, 1e3), "plastic_viscosity": (5.0, 40.0)},
        ),
        Family(
            "drucker_prager",
            (MODULUS, RATIO, Parameter("friction_angle", 30.0, 1.0, 70.0, 1.0)),
            {"youngs_modulus": (1e5, 5e5), "friction_angle": (15.0, 30.0, 45.0)},
        ),
        Family(
            "springs",
            (MODULUS, Parameter("viscosity", 3.0, 0.01, 1e3, 0.1, log=True)),
            {"youngs_modulus": (3e3, 1e4, 3e4, 1e5, 3e5), "viscosity": (1.0, 30.0)},
        ),
    )
}
CONTINUUM_FAMILIES = tuple(kind for kind in FAMILIES if kind in CONTINUUM)
"""Those among which a search for the law chooses. Springs are fitted if they are asked for."""


def law_of(family: Family, values: Mapping[str, float]) -> ClassicalLaw:
    """The law among ``values``."""
    return ClassicalLaw(family.kind, **{p.name: values[p.name] for p in family.parameters})


def family_of(kind: str, density: float, known: Mapping[str, float]) -> Family:
    """The family for a body of ``density`` [kg/m^3] without the parameters that are ``known``."""
    family = FAMILIES[kind].scaled(density)
    return replace(family, parameters=tuple(p for p in family.parameters if p.name not in known))
