r"""Grid spacing and substep from the object, its law and the effects on its stress.

**Sound and matter** cross at most ``courant_number`` cells in a substep.

**Viscosity.** The limit is that of von Neumann's analysis of explicit diffusion: no mode of the grid may be amplified.
In MLS-MPM with quadratic B-splines and a stress $\tau_p = 2 J \eta \operatorname{dev} D_p$ of the velocity gradient
$C_p$ of the substep before, velocities $v_i$ of the nodes go to $A v$ with

.. math::  v^\top\! M A v = \sum_p m_p
   \left(|v_p|^2 + \tfrac{h^2}{4} |C_p|^2 - q\, \tfrac{h^2}{4} |\operatorname{dev} D_p|^2\right),
   \qquad q = \frac{8 J \eta \Delta t}{\rho h^2}

($M$: lumped masses). $v_p + C_p (x_i - x_p)$ is the affine field nearest to the nodes around a particle in least
squares with weights $w_{ip}$, whose second moment is $\tfrac{h^2}{4} I$ wherever the particle is. So the first two
terms are at most $v^\top\! M v$, no eigenvalue of $A$ is below $1 - q$, and $|A| \le 1$ if $q \le 2$:

.. math::  \Delta t \le \frac{\rho h^2}{4 J \eta}

for any arrangement of particles. A lone particle in the middle of a cell attains it: its eight nodes see no more than
an affine motion. Cells that are filled evenly allow more, 2.5 times as much far from a surface (the mean of $|C_p|^2$
over a cell of a velocity along one axis that alternates from node to node).

With elastic forces the limit is less. A mode of a viscous oscillator, $v \leftarrow (1 - c) v - \Delta t\, k x$,
$x \leftarrow x + \Delta t\, v$, is bounded if $2 c + \Delta t^2 k \le 4$ (roots of its characteristic polynomial).
With $c \le q$ and $\Delta t^2 k \le 8 \mu \Delta t^2 / (\rho h^2)$ as above,

.. math::  \frac{4 J \eta \Delta t}{\rho h^2} + \frac{2 \mu \Delta t^2}{\rho h^2} \le 1 .

The second term is at most half the square of the Courant number, since $2 \mu \le M$.
"""

from __future__ import annotations

import math

from masiv.effects.stability import SubstepDemand
from masiv.errors import MasivError
from masiv.mpm.config import SimulatorConfig

STIFFENING = 2.0
"""A law stiffens as it is compressed: the substep is for this multiple of its modulus at rest."""
HELD_MARGIN = 1.4
"""How many times shorter a substep may be needed than the one that is taken, where that is held (``HeldSubsteps``). The
Courant number is then this times ``simulator.courant_number``: below the limit of 1 up to a setting of 0.71 (default
0.3); not derived above."""
DIFFERENCE_MARGIN = 1.1
"""As many times shorter again at the other point of a finite difference: else a law at the margin would have no
derivative by what stiffens it. Chosen; a difference of 20 % of a modulus is within it."""
NO_DEMAND = SubstepDemand()


def grid_spacing(volume: float, particle_count: int, config: SimulatorConfig) -> float:
    """Cell size [m] at which ``particle_count`` particles fill ``volume`` [m^3] with ``particles_per_cell`` each."""
    return (config.particles_per_cell * volume / particle_count) ** (1 / 3)


def viscous_substep(*, spacing: float, density: float, viscosity: float, courant_number: float) -> float:
    r"""The longest substep [s] for an added ``viscosity`` [Pa s]; infinite without one.

    It is $s\, \rho h^2 / (4 \eta)$, see the module, with the safety factor $s = (1 - (m C)^2 / 2) / m$: a substep that
    is held may be $m$ = ``HELD_MARGIN`` times too long, and at a Courant number of $m C$ elastic forces leave that part
    of the limit. s is 0.65 at the default of 0.3. J is taken as 1: a stretch raises q, and cells that stay filled have
    more than that to spare.
    """
    if viscosity <= 0:
        return math.inf
    safety = (1 - 0.5 * (HELD_MARGIN * courant_number) ** 2) / HELD_MARGIN
    return safety * density * spacing**2 / (4 * viscosity)


def substeps_per_frame(
    *,
    spacing: float,
    wave_modulus: float,
    density: float,
    speed: float,
    frame_time: float,
    config: SimulatorConfig,
    demand: SubstepDemand = NO_DEMAND,
) -> int:
    """Substeps in a frame such that sound and matter at ``speed`` [m/s] together cross at most ``courant_number`` cells
    in each, and that ``viscous_substep`` allows. Sound is sqrt(STIFFENING wave_modulus / density), wave_modulus [Pa]
    that of the law at rest times the factor of ``demand``, plus what that adds. Raises MasivError that names the law,
    or the effects, if that is more than the configuration allows."""

    def sound(factor: float, added: float) -> int:
        crossing = math.sqrt(STIFFENING * (factor * max(wave_modulus, 0.0) + added) / density) + speed
        return max(1, math.ceil(frame_time * crossing / (config.courant_number * spacing)))

    diffusion = viscous_substep(
        spacing=spacing, density=density, viscosity=demand.viscosity, courant_number=config.courant_number
    )
    own = sound(1.0, 0.0)
    count = max(sound(demand.modulus_factor, demand.modulus), math.ceil(frame_time / diffusion))
    limit = config.max_substeps_per_frame
    if count > limit:
        if own <= limit:
            asks = f"{' and '.join(demand.effects)} as strong as this (the law alone would need {own})"
        else:
            waves = math.sqrt(STIFFENING * max(wave_modulus, 0.0) / density)
            asks = f"a speed of {speed:.3g} m/s" if speed > waves else f"the law (wave modulus {wave_modulus:.3g} Pa)"
        raise MasivError(
            f"{asks} needs {own if own > limit else count} substeps a frame, more than "
            f"simulator.max_substeps_per_frame = {limit}: raise it, or use fewer particles"
        )
    return count
