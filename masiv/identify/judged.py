"""Which of several fitted families explains what was filmed?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from masiv.errors import NonFiniteError
from masiv.identify.classical_fit import FamilyFit, ranked
from masiv.identify.pictures import compared, picture_objective, shown
from masiv.identify.problem import Problem
from masiv.identify.start import TELLS


def picture_errors_of(problem: Problem, fits: Sequence[FamilyFit]) -> dict[str, float]:
    """How far each family's rollout is from the pictures, weighed as in the last iterations of a neural law, infinite
    where it diverges; nothing where there is no picture to be compared with."""
    if not compared(problem):
        return {}
    weighed = problem.of_surfaces(0)

    def error(found: FamilyFit) -> float:
        try:
            return float(picture_objective(weighed, shown(problem, found.law, found.motion, found.contact)))
        except NonFiniteError:
            return math.inf

    return {found.kind: error(found) for found in fits}


def nearest_first(fits: Sequence[FamilyFit], errors: Mapping[str, float]) -> list[FamilyFit]:
    """By the pictures' ``errors``, and of those that are within ``TELLS`` of the nearest the one with the fewest
    parameters first; by the information criterion of paths where there are none.

    Paths of a body that flows are wrong, and a wrong law may be nearer to them: after short fits, those of a viscous
    sphere prefer a fluid with a yield stress by a quarter of their error, the pictures the true fluid by a third.
    """
    if not errors:
        return ranked(list(fits))
    near = TELLS * min(errors.values())
    return sorted(fits, key=lambda f: (len(f.values) if errors[f.kind] <= near else math.inf, errors[f.kind]))
