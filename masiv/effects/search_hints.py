"""What a search for missing physics has to know of an effect in addition to its equation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from masiv.effects.context import EffectContext


def _identifiable(theta: torch.Tensor, duration: float, places: torch.Tensor) -> str | None:
    return None


@dataclass(frozen=True)
class SearchHints:
    """Policy of a search for one effect. The defaults fit an effect whose response is linear in its strength."""

    guesses: Callable[[EffectContext], list[tuple[float, ...]]] | None = None
    """Values of the parameters after the strengths that the score test tries; None: the starts of the parameters."""
    identifiability_issue: Callable[[torch.Tensor, float, torch.Tensor], str | None] = _identifiable
    """(theta (P,), duration [s], places (M, 3) [m] that points of the body passed) -> why a motion that was observed
    for so long, there, does not distinguish the effect from a simpler one; None if it does."""
    nonsmooth: bool = False
    """The response has no useful derivative at zero strength: it sets in at a finite strength, or all at once."""
    cause: bool = True
    """False for a discrepancy force, which represents unknown physics: no search may name it."""
    on_request: bool = False
    """Looked for only if ``refine.effects`` names it: the error rates of the search were calibrated without it."""
    shape_of: str | None = None
    """Name of the effect that is another shape of the same cause. A configuration that names that one asks for both; a
    model has one of them at most, and they share the prior of one cause."""
    needs_clamp: bool = False
    """Looked for in clamped bodies only: on a free body another effect does the same."""
    inside: bool = False
    """Its place is in the body: it acts on the matter there."""
    replaces_parameter: str | None = None
    """Parameter of the initial state that makes up for the effect if it is missing, and is fixed if it is present."""
