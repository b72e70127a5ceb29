"""A force at one place of the body."""

from __future__ import annotations

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import ForceEffect
from masiv.effects.places import PLACE, as_guesses, face_centres, weights_around
from masiv.effects.search_hints import SearchHints


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """Centres of the body's faces."""
    return as_guesses(face_centres(context.rest))


class PointForce(ForceEffect):
    r"""$f_p = w_p f$ with $\sum_p w_p = 1$: a constant force on the matter around a place of the body at frame 0, with
    the weights of ``PointMass``. It stays with that matter as the body moves. Unlike a mass, it adds no inertia.

    A body in flight moves under it as in a wind, and turns, so it is looked for in clamped bodies.
    """

    name = "point_force"
    looks_like = "a held body rests, or swings about, another place, as fast as it would without"
    parameters = (*(EffectParameter(f"force_{axis}", "N", -1e4, 1e4, 1.0) for axis in "xyz"), *PLACE)
    strengths = 3
    hints = SearchHints(guesses=_guesses, needs_clamp=True, inside=True)

    def force(self, theta, context):
        return weights_around(context.rest, theta[3:6], context.size / 8)[:, None] * theta[:3]
