r"""The kinds of effects: physics that a model may lack. At zero strength an effect changes nothing.

A kind determines where in the model an effect acts, and has one abstract method. In a substep of MLS-MPM
(``masiv.kernels.mpm``) they act in this order:

1. ``StressEffect``: Kirchhoff stress of the particles, after the law; ``HistoryEffect``, one with internal variables;
2. ``NodalEffect``: velocity of the grid's nodes, after gravity;
3. ``ContactEffect``: velocity of the nodes on or below the ground, in place of the model's contact;
4. ``ForceEffect``: velocity of the particles, at the end of the substep;
5. ``SuspendedMassEffect``: a mass with a motion of its own, and the particles that it is tied to.

``MassEffect`` changes the particles' masses, ``GeometryEffect`` the height of the ground and ``ClockEffect`` the times
of the observation, once a rollout. An effect of two kinds derives from both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.per_body import PerBody
from masiv.effects.search_hints import SearchHints
from masiv.effects.stability import SubstepDemand


class Effect(ABC):
    """What all kinds of effects have. Effects derive from the kinds below; one file an effect in ``masiv/effects``.

    A subclass sets ``name``, ``looks_like`` (what it does in a video, one line) and ``parameters``. The first
    ``strengths`` of these are its strength: if they are zero, the effect is absent.
    """

    name: ClassVar[str]
    looks_like: ClassVar[str]
    parameters: tuple[EffectParameter, ...]
    strengths: ClassVar[int] = 1
    hints: ClassVar[SearchHints] = SearchHints()
    per_body: ClassVar[PerBody | None] = None
    """How bodies share the strength; None: as it is."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.__module__ != __name__ and not issubclass(cls, KINDS):
            raise TypeError(f"{cls.__name__} acts nowhere: derive it from one of the kinds in {__name__}")

    def guesses(self, context: EffectContext) -> list[tuple[float, ...]]:
        """Values of the parameters after the strengths that a search tries, each a tuple."""
        if self.hints.guesses is not None:
            return self.hints.guesses(context)
        return [tuple(p.start for p in self.parameters[self.strengths :])]


class GridEffect(Effect):
    """Base of the two kinds that act on the nodes of the grid."""

    def coefficients(self, theta: torch.Tensor, context: EffectContext) -> torch.Tensor:
        """Parameters (P,) -> coefficients c (K,) of the Taichi function; differentiable."""
        return theta


class NodalEffect(GridEffect):
    r"""$v_i \leftarrow g(x_i, v_i, t; c)$ at each node $i$ with mass, after gravity and before contact."""

    @abstractmethod
    def node_velocity(self) -> Callable[..., Any]:
        """Taichi function (x, v, t, dt, dx, c) -> v: position [m], velocity [m/s], time since frame 0 [s], substep [s],
        cell [m], coefficients."""


class ContactEffect(GridEffect):
    r"""$v_i \leftarrow g(x_i, v_i, \hat v_i, t; c)$ at each node $i$ on or below the ground ($y_i \le 0$), with
    $\hat v_i$ the velocity that the model's contact would give. At most one may act."""

    @abstractmethod
    def contact_velocity(self) -> Callable[..., Any]:
        """Taichi function (x, v, held, t, dt, dx, c) -> v: as ``NodalEffect.node_velocity``, held = $\\hat v$ [m/s]."""


class StressEffect(Effect):
    r"""$\tau_p \leftarrow g(\tau_p, F_p, C_p; c_p)$ at each particle $p$: Kirchhoff stress [Pa], elastic deformation
    gradient, velocity gradient [1/s]."""

    @abstractmethod
    def particle_stress(self) -> Callable[..., Any]:
        """Taichi function (tau, F, C, c) -> tau."""

    def coefficients(self, theta: torch.Tensor, context: EffectContext) -> torch.Tensor:
        """Parameters (P,) -> coefficients (N, K) of the particles; differentiable."""
        return theta.expand(len(context.rest), -1)

    def substep_demand(self, theta: torch.Tensor, context: EffectContext) -> SubstepDemand:
        """What parameters (P,) ask of the substep in addition to the law; nothing if not given."""
        return SubstepDemand()


class HistoryEffect(StressEffect):
    r"""$\tau_p \leftarrow \tau_p + \sum_b h_{pb}$ with $h_{pb}, q_{pb} \leftarrow g(\tau_p, F_p, C_p, q_{pb}; c_{pb})$
    at each particle $p$: branches $b$ with internal variables $q$ that the rollout keeps. At most one may act.

    ``coefficients`` (N, K) are those of the first branch, of the second and so on.
    """

    branches: ClassVar[int]
    internal_variables: ClassVar[int]
    """Numbers of a particle and a branch."""

    @abstractmethod
    def particle_stress(self) -> Callable[..., Any]:
        """Taichi function (tau, F, C, q, dt, known, c) -> (h, q) of a branch: as ``StressEffect.particle_stress``,
        internal variables, substep [s], and 1, or 0 in the first substep of a rollout, where nothing is remembered and
        q is that of a body that has been in its shape for long."""


class MassEffect(Effect):
    r"""$m_p \leftarrow s_p(\theta)\, m_p$ at each particle $p$."""

    @abstractmethod
    def mass_factor(self, theta: torch.Tensor, context: EffectContext) -> torch.Tensor:
        """Factors s (N,) [1]; differentiable."""


class ForceEffect(Effect):
    r"""$v_p \leftarrow v_p + \Delta t\, f_p(\theta) / m_p$ at each particle $p$, with a force that is constant in
    time."""

    @abstractmethod
    def force(self, theta: torch.Tensor, context: EffectContext) -> torch.Tensor:
        """Forces f (N, 3) [N]; differentiable."""


@dataclass(frozen=True)
class SuspendedMass:
    """mass [kg] on an inextensible thread of length [m], tied to the particles with weights (N,) of sum 1; fixed to
    them if the length is 0."""

    mass: float
    length: float
    weights: torch.Tensor


class SuspendedMassEffect(Effect):
    r"""$v_p \leftarrow v_p + w_p \lambda n / m_p$ at each particle $p$, $u \leftarrow u + \Delta t\, g - \lambda n / M$
    with the impulse $\lambda$ of a thread along $n$, or, without a thread, of a joint in any direction: a mass $M$
    with the velocity $u$ hangs from the body. At most one may act. A rollout with it has no gradient."""

    @abstractmethod
    def suspended_mass(self, theta: torch.Tensor, context: EffectContext) -> SuspendedMass:
        """The mass, its thread, and where it is tied."""


class GeometryEffect(Effect):
    r"""The ground is at $y = h(\theta)$ in place of $y = 0$."""

    @abstractmethod
    def ground_shift(self, theta: torch.Tensor) -> torch.Tensor:
        """Height h () [m]; differentiable."""


class ClockEffect(Effect):
    r"""A frame with time stamp $t$ was taken at $t + \delta(\theta)$."""

    @abstractmethod
    def time_shift(self, theta: torch.Tensor) -> torch.Tensor:
        """Delay () [s]; differentiable."""


KINDS = (
    NodalEffect,
    ContactEffect,
    StressEffect,
    MassEffect,
    ForceEffect,
    SuspendedMassEffect,
    GeometryEffect,
    ClockEffect,
)
