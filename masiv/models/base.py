r"""What every forward model is, and what is fitted through it.

A forward model predicts an observation :math:`y_e(t_k, n)`, the place of point :math:`n` at instant :math:`t_k` of
recording :math:`e`, from a ``Model`` and values :math:`\theta` of its parameters:

.. math::  y_e = f_e(\theta_\text{law}, \theta_\text{effects}, \theta_e) + \varepsilon_e

The law and the effects are shared by all recordings; :math:`\theta_e` (initial state, release, grid correction) belongs
to one of them and is named ``parameter@recording``.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.models.families import Family
from masiv.models.parameters import Parameter
from masiv.scene.transforms import SimulationFrame
from masiv.workers import Workers

Self = TypeVar("Self", bound="ForwardModel")


@dataclass(frozen=True)
class Model:
    """A law's family (with the parameters to fit), how the ground holds the body, and effects by name."""

    family: Family
    contact: str
    effects: tuple[str, ...] = ()

    def with_effect(self, name: str) -> Model:
        """The same with one effect more."""
        return replace(self, effects=(*self.effects, name))


class FittedModel(Protocol):
    """A model with values of its parameters."""

    @property
    def model(self) -> Model: ...

    @property
    def values(self) -> Mapping[str, float]: ...


@dataclass(frozen=True)
class EffectTerm:
    """An effect as it may be added to a model.

    name: that of the effect, followed by the bodies that it acts on unless it acts on all. strengths: parameters that
    are zero if it is absent; others: its places, frequencies and so on. guesses: values of the others to try in the
    score test. units: by parameter. bodies: that it acts on; empty: all. replaces_parameter: parameters of a model
    without it that it makes superfluous. nonsmooth: see ``Effect``.
    """

    name: str
    effect: str
    strengths: tuple[Parameter, ...]
    others: tuple[Parameter, ...]
    guesses: tuple[tuple[float, ...], ...]
    units: dict[str, str]
    bodies: tuple[str, ...] = ()
    replaces_parameter: tuple[str, ...] = ()
    nonsmooth: bool = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Strengths, then others."""
        return (*self.strengths, *self.others)


def effect_parameters(name: str) -> tuple[Parameter, ...]:
    """The parameters of an effect, named ``effect.parameter``."""
    return tuple(
        Parameter(f"{name}.{p.name}", float(np.clip(p.start, p.lower, p.upper)), p.lower, p.upper, p.step)
        for p in effect_named(name).parameters
    )


def plain_term(name: str, context: EffectContext) -> EffectTerm:
    """An effect of the library that acts on everything."""
    effect = effect_named(name)
    own = effect_parameters(name)
    units = {f"{name}.{p.name}": p.unit for p in effect.parameters}
    cut = effect.strengths
    guesses = tuple(tuple(g) for g in effect.guesses(context))
    return EffectTerm(name, name, own[:cut], own[cut:], guesses, units, nonsmooth=effect.hints.nonsmooth)


class ForwardModel(ABC):
    """Predictions of models for ``observations`` (``masiv.observations.base.Observation``, names all different).

    A subclass says what is fitted, which effects could act, and what it predicts. The other methods have answers that
    hold for a model without a grid whose derivatives are good everywhere.
    """

    observations: Sequence[Any]
    workers: Workers = Workers()
    """Processes for simulations that do not depend on each other, see ``with_workers``."""

    def __init__(self, observations: Sequence[Any]) -> None:
        """Raises ValueError if two observations have the same name: they would share parameters."""
        names = [o.name for o in observations]
        if len(set(names)) < len(names):
            raise ValueError(f"observations need different names, these have {', '.join(names)}")
        self.observations = tuple(observations)
        self._rollouts = [0]

    @property
    def rollouts(self) -> int:
        """Simulations so far, those of copies with other observations included."""
        return self._rollouts[0]

    @rollouts.setter
    def rollouts(self, count: int) -> None:
        self._rollouts[0] = count

    def with_observations(self: Self, observations: Sequence[Any]) -> Self:
        """A copy that compares with ``observations``: the same, with another noise model or grid corrections. It shares
        caches, held substeps and the count of rollouts with this one, which keeps its own observations."""
        out = copy.copy(self)
        out.observations = tuple(observations)
        return out

    def with_workers(self: Self, workers: Workers) -> Self:
        """A copy that takes derivatives in several processes. It shares with this one what a copy with other
        observations does."""
        out = copy.copy(self)
        out.workers = workers
        return out

    def held_at(self: Self, values: Mapping[str, float]) -> Self:
        """A copy for finite differences about ``values``: what depends on the values and is not smooth in them, such as
        a number of substeps, is as at ``values``. It shares with this one what a copy with other observations does."""
        return self

    def shorten_substeps(self, model: Model, values: Mapping[str, float]) -> bool:
        """Simulate with shorter substeps from now on, in all that shares them, if a fit that ended at ``values`` may
        have been stopped by how long they are; whether it was. Not if there would be too many."""
        return False

    @abstractmethod
    def parameters(self, model: Model) -> tuple[Parameter, ...]:
        """Everything that is fitted: law, effects, and what belongs to each recording."""

    @abstractmethod
    def candidates(self, model: Model) -> Sequence[str]:
        """Names of the terms that ``model`` lacks and that could act here."""

    @abstractmethod
    def term(self, name: str) -> EffectTerm:
        """The term of that name. Raises InputError for an unknown effect."""

    @abstractmethod
    def fields(self, model: Model, values: Mapping[str, float], *, held_out: bool = False) -> list[np.ndarray]:
        """Predicted less observed (K, N, A) [m] of each recording: the fitted instants, and the rest if ``held_out``.
        Raises NonFiniteError."""

    def residual(self, model: Model, values: Mapping[str, float]) -> np.ndarray:
        """The fitted instants of all recordings, whitened (``Observation.whiten``), flat (M,) [m]. Raises
        NonFiniteError."""
        found = zip(self.observations, self.fields(model, values), strict=True)
        return np.concatenate([e.whiten(f).ravel() for e, f in found])

    def effect_axes(self, index: int) -> SimulationFrame:
        """Axes in which effects act in recording ``index``: those of the world, unless a subclass has others."""
        return SimulationFrame(np.eye(3), np.zeros(3))

    def effect_gravity(self, index: int) -> np.ndarray | None:
        """Gravity (3,) [m/s^2] in ``effect_axes``; None if it is not known."""
        return None

    def nuisance(self, model: Model, values: Mapping[str, float], index: int) -> np.ndarray:
        """Derivatives (T, N, A, Q) of recording ``index`` by what is fitted to it alone for each model, such as the
        start of a held-out flight. Q is 0 if there is nothing of the kind."""
        return np.zeros((*self.observations[index].values.shape, 0))

    def finer_grids(self, model: Model, values: Mapping[str, float], index: int) -> list[np.ndarray]:
        """What each of two or more finer grids changes (T, N, A) [m] of recording ``index``. Empty if there is no grid,
        or if its change says nothing; all recordings have as many. Raises MasivError."""
        return []

    def reset_initial_conditions(self, values: Mapping[str, float]) -> dict[str, float]:
        """``values`` with the initial state of each recording as its first frames alone have it, if that is known."""
        return dict(values)

    def curriculum(self: Self, fields: Sequence[np.ndarray]) -> Sequence[Self]:
        """Models of shorter parts of the recordings, to fit one after the other before the whole, if the residual
        ``fields`` (T, N, A) [m] over all instants are so large that derivatives of the whole mislead. Else empty."""
        return ()

    def is_out_of_phase(self, fields: Sequence[np.ndarray]) -> bool:
        """Whether the residual ``fields`` (T, N, A) [m] are so large that derivatives mislead, and no shorter part of
        the recordings helps."""
        return False

    def impossible(self, fitted: FittedModel, term: EffectTerm) -> list[str]:
        """Why ``term`` cannot act as ``fitted`` has it, or could not be told from a simpler one, in words."""
        return []
