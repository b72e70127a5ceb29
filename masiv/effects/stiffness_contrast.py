"""A part that is stiffer or softer than the rest."""

import taichi as ti
import torch

from masiv.effects._place import PLACE, as_guesses, cover, square_distance
from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _scaled(tau, f, c_affine, c):
    return ti.exp(c[0]) * tau


class StiffnessContrast(Effect):
    """tau *= exp(theta b), b = exp(-|X - place|^2 / (2 radius^2)) at the particle's position X at frame 0."""

    name = "stiffness_contrast"
    looks_like = "one part gives way less, or more, than the rest when the body hits something"
    parameters = (
        EffectParameter("log_stiffness_ratio", "1", -2.0, 2.0, 0.1),
        *PLACE,
        EffectParameter("radius", "m", 0.01, 10.0, 0.02, start=0.15),
    )
    on_stress = True

    def particle_stress(self):
        return _scaled

    def coefficients(self, theta, setting):
        bump = torch.exp(-0.5 * square_distance(setting.rest, theta[1:4]) / theta[4] ** 2)
        return (theta[0] * bump)[:, None]

    def guesses(self, setting):
        """Eight parts of the body, each with the radius of such a part."""
        return as_guesses(cover(setting.rest, 8), 0.25 * setting.size)
