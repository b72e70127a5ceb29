"""Stress that relaxes: a body that creeps under a load and springs back slowly."""

import math

import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import HistoryEffect
from masiv.effects.search_hints import SearchHints
from masiv.effects.stability import SubstepDemand
from masiv.kernels.tensor import deviator, identity3, symmetric, symmetric_part

BRANCHES = 3
TIMES = (0.02, 0.2, 2.0)
MIN_TIME, MAX_TIME = 1e-3, 100.0
"""Of a branch [s]."""


@ti.func
def _branch(tau, f, c_affine, q, dt, known, c):
    line = identity3() + dt * c_affine
    decay, target = ti.exp(-dt * c[1]), (c[0] * ti.exp(-0.5 * dt * c[1])) * deviator(tau)
    # What is kept is decay * h - target of the substep before: the new h lacks only its target.
    kept = deviator(symmetric_part(line @ symmetric(q[0], q[1], q[2], q[3], q[4], q[5]) @ line.transpose()))
    h = known * (kept + target)
    w = decay * h - target
    return h, ti.Vector([w[0, 0], w[0, 1], w[0, 2], w[1, 1], w[1, 2], w[2, 2]])


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """From two frames to the duration, evenly in the logarithm: what is faster looks elastic or viscous, what is slower
    stays as it is."""
    low = min(max(2 * context.frame_time, MIN_TIME), MAX_TIME)
    high = min(max(context.duration, 2 * low), MAX_TIME)
    return [tuple(low * (high / low) ** (i / (BRANCHES - 1)) for i in range(BRANCHES))]


class Relaxation(HistoryEffect):
    r"""$\tau \leftarrow \tau + \sum_i h_i$, $\overset{\triangledown}{h}_i + h_i / T_i = \gamma_i
    \overset{\triangledown}{(\operatorname{dev} \tau)}$: Maxwell branches beside the law.

    The generalised Maxwell model at finite strain (Simo 1987; Simo and Hughes 1998, chapter 10), with stresses that
    the motion carries along (upper-convected rate). A branch has $\gamma_i$ times the shear modulus $G$ of the law,
    which is that after a long time: $G(t) = G\,(1 + \sum_i \gamma_i e^{-t / T_i})$ after a sudden strain; at the
    frequency $\omega$ the storage modulus is $G\,(1 + \sum_i \gamma_i \omega^2 T_i^2 / (1 + \omega^2 T_i^2))$ and the
    loss modulus $G \sum_i \gamma_i \omega T_i / (1 + \omega^2 T_i^2)$. A substep adds $\gamma_i e^{-\Delta t / 2 T_i}
    \Delta \operatorname{dev} \tau$ to $e^{-\Delta t / T_i} h_i$, which is of second order and stable at any $T_i$. The
    body is taken to have been in its first shape for long: there $h_i = 0$. There is no bulk part: bodies hardly change
    their volume. Looked for on request: few records are long enough.
    """

    name = "relaxation"
    looks_like = "a loaded body sags further with time, and a released one comes back late; wobbles die out"
    parameters = (
        *(EffectParameter(f"fraction_{i + 1}", "1", 0.0, 5.0, 0.02) for i in range(BRANCHES)),
        *(EffectParameter(f"time_{i + 1}", "s", MIN_TIME, MAX_TIME, 0.1 * t, t) for i, t in enumerate(TIMES)),
    )
    strengths = BRANCHES
    hints = SearchHints(guesses=_guesses, on_request=True)
    branches = BRANCHES
    internal_variables = 6  # a symmetric matrix

    def particle_stress(self):
        return _branch

    def coefficients(self, theta, context):
        own = torch.stack([theta[:BRANCHES], 1 / theta[BRANCHES:]], dim=1).flatten()
        return own.expand(len(context.rest), -1)

    def substep_demand(self, theta, context):
        return SubstepDemand(modulus_factor=1 + float(theta[:BRANCHES].clamp_min(0).sum()))


def shear_moduli(theta: torch.Tensor, modulus: float, frequencies: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Storage and loss modulus (K,) [Pa] of shear at ``frequencies`` (K,) [Hz], of a law with the shear modulus
    ``modulus`` [Pa] and values ``theta`` (P,) of the effect. Young's moduli of a material that keeps its volume are
    three times as large."""
    omega = 2 * math.pi * frequencies[:, None] * theta[BRANCHES:]
    weights = theta[:BRANCHES] / (1 + omega.square())
    return modulus * (1 + (weights * omega.square()).sum(1)), modulus * (weights * omega).sum(1)
