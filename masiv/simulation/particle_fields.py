"""What a simulated body feels: stress, strain, and the acceleration that each effect gives, as the simulator has them.

At an instant the simulator takes one more substep, apart from the rollout. Its law and its effects on the stress give
the stress. The same substep without an effect gives that effect's acceleration: the difference of the velocities over
the substep. So an effect of any kind has one, whether it acts on nodes, stress, masses, forces or the contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.effects.active import ActiveEffects
from masiv.effects.effect import ClockEffect, Effect, GeometryEffect
from masiv.materials.law import Law
from masiv.materials.measures import deviatoric_strain, von_mises_stress
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.scene.transforms import SimulationFrame


@dataclass(frozen=True)
class ParticleFields:
    """stress (T, Q) [Pa]: von Mises, of the Cauchy stress; strain (T, Q) [1]: elastic equivalent deviatoric Hencky
    strain; accelerations: by name of the effect, (T, Q, 3) [m/s², world]. stress and strain are None of rigid bodies.
    """

    stress: np.ndarray | None
    strain: np.ndarray | None
    accelerations: dict[str, np.ndarray]

    def at(self, index: np.ndarray) -> ParticleFields:
        """Linearly between the instants, at ``index`` (K,), fractions of their numbers; as float32."""
        low = np.clip(np.floor(index).astype(int), 0, None)
        share = (index - low).astype(np.float32)

        def between(field: np.ndarray) -> np.ndarray:
            high = np.minimum(low + 1, len(field) - 1)
            weight = share.reshape(-1, *[1] * (field.ndim - 1))
            return ((1 - weight) * field[low] + weight * field[high]).astype(np.float32)

        return ParticleFields(
            None if self.stress is None else between(self.stress),
            None if self.strain is None else between(self.strain),
            {name: between(field) for name, field in self.accelerations.items()},
        )


def accelerates(effect: Effect) -> bool:
    """Whether ``effect`` acts in a substep; another ground or another clock does not."""
    return not isinstance(effect, (GeometryEffect, ClockEffect))


def stacked(instants: Sequence[ParticleFields]) -> ParticleFields:
    """Fields of one instant each -> of all of them."""
    stress = [f.stress for f in instants if f.stress is not None]
    strain = [f.strain for f in instants if f.strain is not None]
    return ParticleFields(
        np.concatenate(stress) if stress else None,
        np.concatenate(strain) if strain else None,
        {name: np.concatenate([f.accelerations[name] for f in instants]) for name in instants[0].accelerations},
    )


def fields_at(
    simulator: Simulator,
    law: Law,
    state: State,
    effects: ActiveEffects | None,
    causes: Sequence[Effect],
    time: float,
    axes: SimulationFrame,
) -> ParticleFields:
    """Fields of one instant (T = 1) of ``simulator`` at ``state``. causes: those of ``effects`` whose acceleration is
    wanted. time [s]; axes: world -> simulation. Raises NonFiniteError."""
    taken = simulator.run(state, law, 1, [], effects, time)
    gradient, kirchhoff = taken.read_stress(0)
    velocity = taken.final.velocity
    accelerations = {}
    for cause in causes:
        assert effects is not None
        others = tuple((effect, theta) for effect, theta in effects.members if effect is not cause)
        without = simulator.run(state, law, 1, [], ActiveEffects(others, effects.context), time).final.velocity
        given = (velocity - without).double().numpy() / simulator.substep
        accelerations[cause.name] = axes.vectors_to_world(given).astype(np.float32)[None]
    stress = von_mises_stress(kirchhoff, gradient).float().numpy()[None]
    return ParticleFields(stress, deviatoric_strain(gradient).float().numpy()[None], accelerations)
