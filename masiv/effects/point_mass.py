"""Something heavy inside, or hung on."""

from __future__ import annotations

import torch

from masiv.effects._place import PLACE, as_guesses, cover, faces, shares
from masiv.effects.effect import Effect, EffectParameter


class PointMass(Effect):
    """Mass added round a place of the body at frame 0, a Gaussian of radius 1/8 of its size whose middle is the place.

    The particles share it in full, wherever the place is: their masses grow by exactly the parameter. At a surface it
    lies in the outermost particles.
    """

    name = "point_mass"
    looks_like = "the body turns about a point that is not its middle, and swings round its heavy end"
    inside = True
    parameters = (EffectParameter("mass", "kg", 0.0, 1000.0, 1.0), *PLACE)

    def mass_factor(self, theta, setting):
        return 1 + theta[0] / setting.particle_mass * shares(setting.rest, theta[1:4], setting.size / 8)

    def guesses(self, setting):
        """Middles of six parts of the body (mass in its very middle would hardly show) and of its faces."""
        return as_guesses(torch.cat([cover(setting.rest, 6), faces(setting.rest)]))
