"""Stress over strain of two laws in uniaxial tension, as a tester would measure it.

python examples/stress_strain.py [PICTURE.png]          (seconds; no simulation)
"""

import sys

import numpy as np

from masiv.characterization.curves import uniaxial
from masiv.materials.classical import ClassicalLaw

STRAINS = np.linspace(0.0, 0.2, 21)
LAWS = {
    "neo-Hookean": ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3),
    "von Mises": ClassicalLaw("von_mises", youngs_modulus=3e4, poissons_ratio=0.3, yield_stress=1.5e3),
}


def main(picture: str | None = None) -> dict[str, np.ndarray]:
    curves = {name: uniaxial(law, STRAINS, dt=1e-3).stress for name, law in LAWS.items()}
    for name, stress in curves.items():
        print(f"{name:12s} stress [kPa] at 2, 10 and 20 %:", np.round(1e-3 * stress[[2, 10, 20]], 2))
    if picture is not None:
        from matplotlib import pyplot

        for name, stress in curves.items():
            pyplot.plot(STRAINS, 1e-3 * stress, label=name)
        pyplot.xlabel("axial strain")
        pyplot.ylabel("stress [kPa]")
        pyplot.legend()
        pyplot.savefig(picture)
    return curves


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
