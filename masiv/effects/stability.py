"""What effects on the stress ask of the substep."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SubstepDemand:
    """modulus_factor [1]: the largest factor, at least 1, by which stress is scaled anywhere in the body; modulus [Pa]:
    the largest that is added to the law's wave modulus; viscosity [Pa s]: the largest that is added; effects: names of
    those that ask for anything, which ``ActiveEffects`` gives."""

    modulus_factor: float = 1.0
    modulus: float = 0.0
    viscosity: float = 0.0
    effects: tuple[str, ...] = ()

    def then(self, later: SubstepDemand) -> SubstepDemand:
        """Of both, where ``later`` acts on the stress that this one left: its factor scales what was added before."""
        return SubstepDemand(
            self.modulus_factor * later.modulus_factor,
            self.modulus * later.modulus_factor + later.modulus,
            self.viscosity * later.modulus_factor + later.viscosity,
            (*self.effects, *later.effects),
        )
