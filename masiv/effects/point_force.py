"""Something that pulls or pushes at one place."""

from __future__ import annotations

from masiv.effects._place import PLACE, as_guesses, faces, shares
from masiv.effects.effect import Effect, EffectParameter


class PointForce(Effect):
    """A force that does not change, on the matter round a place of the body at frame 0 (spread as ``PointMass`` is):
    it stays with that matter as the body moves. Unlike a mass, it slows nothing.

    A body in flight moves under it as in a wind, and turns, so it is looked for in bodies that are held.
    """

    name = "point_force"
    looks_like = "a held body rests, or swings about, another place, as fast as it would without"
    parameters = (*(EffectParameter(f"force_{axis}", "N", -1e4, 1e4, 1.0) for axis in "xyz"), *PLACE)
    strengths = 3
    needs_clamp = True
    inside = True

    def force(self, theta, setting):
        return shares(setting.rest, theta[3:6], setting.size / 8)[:, None] * theta[:3]

    def guesses(self, setting):
        """Middles of the body's faces."""
        return as_guesses(faces(setting.rest))
