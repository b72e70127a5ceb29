"""Something heavy inside."""

from __future__ import annotations

import torch

from masiv.effects._place import PLACE, as_guesses, cover, square_distance
from masiv.effects.effect import Effect, EffectParameter


class PointMass(Effect):
    """Mass added around a place of the body at frame 0, spread as exp(-|X - place|^2 / (2 r^2)), r 1/8 of its size.

    The particles share it in full, wherever the place is: their masses grow by exactly the parameter.
    """

    name = "point_mass"
    looks_like = "the body turns about a point that is not its middle, and swings round its heavy end"
    parameters = (EffectParameter("mass", "kg", 0.0, 1000.0, 1.0), *PLACE)

    def mass_factor(self, theta, setting):
        radius = setting.size / 8
        share = torch.softmax(-0.5 * square_distance(setting.rest, theta[1:4]) / radius**2, 0)
        return 1 + theta[0] / setting.particle_mass * share

    def guesses(self, setting):
        """Middles of eight parts of the body: mass in its very middle would hardly show."""
        return as_guesses(cover(setting.rest, 8))
