"""What the loop asks of a simulation, whatever is simulated: a body filmed, a body with markers, a group of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.identify.parametric import Parameter

if TYPE_CHECKING:
    from collections.abc import Mapping

    from masiv.effects.effect import Setting
    from masiv.refine.config import RefineConfig
    from masiv.refine.model import Model
    from masiv.refine.refit import Fitted


@dataclass(frozen=True)
class Term:
    """An effect as it may be added to a model. name: that of the effect, followed by whom it acts on where that is not
    everything; strengths: parameters that are zero where it is absent; others: its places, frequencies…; guesses:
    values of the others to try in the score test; units by parameter; bodies: whom it acts on (none: everything);
    stands_for: parameters of a model without it that it makes superfluous; kinked: see ``Effect``."""

    name: str
    effect: str
    strengths: tuple[Parameter, ...]
    others: tuple[Parameter, ...]
    guesses: tuple[tuple[float, ...], ...]
    units: dict[str, str]
    bodies: tuple[str, ...] = ()
    stands_for: tuple[str, ...] = ()
    kinked: bool = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*self.strengths, *self.others)


def effect_parameters(name: str) -> tuple[Parameter, ...]:
    """The parameters of an effect, named ``effect.parameter``."""
    return tuple(
        Parameter(f"{name}.{p.name}", float(np.clip(p.start, p.lower, p.upper)), p.lower, p.upper, p.step)
        for p in effect_named(name).parameters
    )


def plain_term(name: str, setting: Setting) -> Term:
    """An effect of the library that acts on everything."""
    effect = effect_named(name)
    own = effect_parameters(name)
    units = {f"{name}.{p.name}": p.unit for p in effect.parameters}
    cut = effect.strengths
    guesses = tuple(tuple(g) for g in effect.guesses(setting))
    return Term(name, name, own[:cut], own[cut:], guesses, units, kinked=effect.kinked)


class Watched(Protocol):
    """One experiment: K instants at which N points are compared, the first ``rows`` of them fitted, the rest held
    out. noise [m]: of the observation; sigma (K,) [m]: by how much model and observation may differ with nothing
    missing; grid_changes: what each finer grid changes (K, N, A) [m], none while that is not known.
    ``dataclasses.replace`` gives it another sigma."""

    @property
    def noise(self) -> float: ...

    @property
    def sigma(self) -> np.ndarray: ...

    @property
    def grid_changes(self) -> tuple[np.ndarray, ...]: ...

    @property
    def instants(self) -> int: ...

    def weighted(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] from the first instant on, in proportion to what it says."""
        ...

    @property
    def name(self) -> str: ...

    @property
    def rows(self) -> int: ...

    @property
    def holds_out(self) -> bool: ...

    @property
    def places(self) -> np.ndarray:
        """Where the points are at the start (N, 3) [m]."""
        ...


class Weighing:
    """A part of ``Watched``: residuals in proportion to what they say."""

    noise: float
    sigma: np.ndarray
    grid_changes: tuple[np.ndarray, ...] = ()

    def weighted(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] from the first instant on: as it is where sigma is the noise, less where the model
        itself is less certain."""
        return field * (self.noise / self.sigma[: len(field), None, None])


class WholeRun(Weighing):
    """A part of ``Watched``: a run of which all or no instants are fitted."""

    times: np.ndarray
    fitted: bool

    @property
    def instants(self) -> int:
        return len(self.times)

    @property
    def rows(self) -> int:
        return len(self.times) if self.fitted else 0

    @property
    def holds_out(self) -> bool:
        return not self.fitted


class Simulated(Protocol):
    """Residuals of models over experiments, and the parameters of a model."""

    rollouts: int
    experiments: Sequence[Any]
    """Of ``Watched``; the loop replaces them by the same with another sigma."""

    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Everything that is fitted: law, effects, and the start of each experiment."""
        ...

    def candidates(self, model: Model) -> Sequence[str]:
        """Names of the terms that ``model`` lacks and that could act here."""
        ...

    def term(self, name: str) -> Term: ...

    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Simulated less observed (K, N, A) [m] of each experiment in the A axes that were measured: its fitted
        instants, and the rest on request. Raises NonFiniteError."""
        ...

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """The fitted instants of all experiments, weighted, flat."""
        ...

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """What each of two or more finer grids changes, as a field over all instants of experiment ``index``; none:
        there is no finer, or it tells nothing. All experiments have as many."""
        ...

    def begun(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` with the start of each experiment as its first moments alone have it, where those are known."""
        ...

    def early(self, base: Fitted) -> Sequence[Simulated]:
        """Shorter simulations through which refits go first, where ``base`` is so far off in the whole one that its
        derivatives point nowhere; none otherwise."""
        ...

    def lost(self, base: Fitted) -> bool:
        """Whether ``base`` is so far off in this simulation that derivatives at it point nowhere."""
        ...

    def objections(self, before: Fitted, after: Fitted, term: Term, config: RefineConfig) -> list[str]:
        """Reasons of its own against adding ``term``."""
        ...
