"""A mass that hangs from the body on a thread, or is fixed to it."""

from __future__ import annotations

import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import SuspendedMass, SuspendedMassEffect
from masiv.effects.places import PLACE, as_guesses, face_centres, spacing_of, tied_weights
from masiv.effects.search_hints import SearchHints

LENGTHS = (0.0, 1.0)
"""Of threads that a search tries, in sizes of the body; without length the mass is fixed. Chosen: no body asked for
these."""


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """At the centres of the body's faces, fixed and on a thread. The matter of the outermost particles ends half a
    spacing further out."""
    outermost = face_centres(context.rest)
    outwards = torch.stack([side * axis for axis in torch.eye(3) for side in (-1, 1)]).to(outermost)
    faces = outermost + 0.5 * spacing_of(context.rest) * outwards
    return [guess for size in LENGTHS for guess in as_guesses(faces, size * context.size)]


class HungMass(SuspendedMassEffect):
    r"""$M\,\dot u = M g - T n$, $f_p = w_p T n$ with $T \ge 0$ such that $|y - \sum_p w_p x_p| \le L$: a mass $M$ at
    $y$ hangs on a thread of length $L$, tied to the matter around a place of the body at frame 0. For $L = 0$ it is
    fixed there, $y = \sum_p w_p x_p$, with forces in all directions.

    The weights are those of ``PointMass``, corrected so that their mean is the place at a face, too: a mass at the very
    face, where ``PointMass`` has no matter to put it on. The thread does not stretch, has no weight and can go slack:
    the mass loads the body by its weight and takes part in its motion along the thread only; across it, it swings as a
    pendulum with the period $2 \pi \sqrt{L / |g|}$. At frame 0 it hangs straight down and moves with that matter. It
    meets neither the body nor the ground. A rollout with it has no gradient. Looked for in clamped bodies, on request.
    """

    name = "hung_mass"
    looks_like = "a held body sags and bobs as with a heavy end, and swings sideways as if it were free"
    parameters = (
        EffectParameter("mass", "kg", 0.0, 1000.0, 1.0),
        *PLACE,
        EffectParameter("length", "m", 0.0, 100.0, 0.05, 0.2),
    )
    hints = SearchHints(guesses=_guesses, needs_clamp=True, inside=True, on_request=True)

    def suspended_mass(self, theta: torch.Tensor, context: EffectContext) -> SuspendedMass:
        weights = tied_weights(context.rest, theta[1:4], context.size / 8)
        return SuspendedMass(float(theta[0]), float(theta[4]), weights)
