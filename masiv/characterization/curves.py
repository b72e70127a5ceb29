"""Stress of a law along prescribed deformations, flow included, as a material tester would measure it.

One material point in float64, driven by increments of the deformation gradient as a particle of the simulator is:
F <- project(dF F, dt), then the stress. Stresses are Kirchhoff [Pa], strains logarithmic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from masiv.materials.law import Law
from masiv.materials.measures import deviatoric_strain

DIFFERENCE_STRAIN = 1e-5
"""Strain [1] of the finite differences at rest."""


@dataclass(frozen=True)
class Curve:
    """A loading and unloading: strain (T,), stress (T,) [Pa], and the elastic part (T,) of the strain."""

    strain: np.ndarray
    stress: np.ndarray
    elastic: np.ndarray

    @property
    def permanent(self) -> np.ndarray:
        """The strain (T,) that would stay without stress."""
        return self.strain - self.elastic


def in_float64(law: Law) -> Law:
    """A frozen copy of ``law`` in float64."""
    return law.frozen().double()


def moduli_at_rest(law: Law) -> tuple[float, float]:
    """Shear and bulk modulus [Pa] of the stress at F = I, nothing flowing: 2 G = d tau_dev / d eps, K = dp / d ln J."""
    law = in_float64(law)
    strain = DIFFERENCE_STRAIN * torch.tensor([[1.0, -1.0, 0.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    with torch.no_grad():
        forth, back = (law.stress(torch.diag_embed(torch.exp(sign * strain))) for sign in (1, -1))
    slope = (forth - back) / (2 * DIFFERENCE_STRAIN)
    return float(slope[0, 0, 0] - slope[0, 1, 1]) / 4, float(slope[1].trace()) / 9


def drive(law: Law, increments: torch.Tensor, dt: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Elastic gradients and stresses (T, B, 3, 3) of B points from rest under ``increments`` (T, B, 3, 3), dt [s] each.

    law: in float64, see ``in_float64``.
    """
    state = torch.eye(3, dtype=torch.float64).expand(increments.shape[1:])
    states = []
    with torch.no_grad():
        for increment in increments:
            state = law.project(increment @ state, dt)
            states.append(state)
        gradients = torch.stack(states)
        return gradients, law.stress(gradients.flatten(0, 1)).reshape(gradients.shape)


def there_and_back(amount: float, steps: int) -> np.ndarray:
    """Strains (2 * steps,) from 0 in equal increments to ``amount`` and back, 0 itself at the end only."""
    up = amount * np.arange(1, steps + 1) / steps
    return np.concatenate([up, up[::-1] - amount / steps])


def simple_shear(amounts: np.ndarray, log_volume: float = 0.0) -> torch.Tensor:
    """Increments (T, 3, 3) that make the shears ``amounts`` (T,), the first also the compression to ``log_volume``."""
    out = torch.eye(3, dtype=torch.float64).repeat(len(amounts), 1, 1)
    out[:, 0, 1] = torch.as_tensor(np.diff(amounts, prepend=0.0))
    out[0] *= float(np.exp(log_volume / 3))
    return out


def stretch(strains: np.ndarray) -> torch.Tensor:
    """Increments (T, 3, 3) of a stretch of one axis to the strains (T,) at constant volume."""
    step = torch.as_tensor(np.diff(strains, prepend=0.0))
    return torch.diag_embed(torch.exp(torch.stack([step, -step / 2, -step / 2], dim=1)))


def dilation(log_volumes: np.ndarray) -> torch.Tensor:
    """Increments (T, 3, 3) of a change of volume to ln J (T,)."""
    step = torch.as_tensor(np.diff(log_volumes, prepend=0.0)) / 3
    return torch.diag_embed(torch.exp(step)[:, None].expand(-1, 3))


def uniaxial(law: Law, strains: np.ndarray, dt: float) -> Curve:
    """Axial stress at axial strains (T,), dt [s] an increment, with the sides free: their stretch is solved for."""
    law = in_float64(law)
    state = torch.eye(3, dtype=torch.float64)[None]
    stresses, elastic = [], []
    with torch.no_grad():
        for step in np.diff(strains, prepend=0.0):
            state, stress = _free_sides(law, state, float(step), dt)
            stresses.append(float(stress[0, 0]))
            elastic.append(float(torch.log(state[0, 0, 0])))
    return Curve(np.asarray(strains), np.array(stresses), np.array(elastic))


def _free_sides(law: Law, state: torch.Tensor, step: float, dt: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The state (1, 3, 3) and stress (3, 3) after an axial strain ``step`` whose side stress is zero.

    Regula falsi (Illinois). Without a change of sign, as of a heap that carries nothing sideways, the side is let go
    at its least stress.
    """

    def tried(side: float) -> tuple[float, torch.Tensor, torch.Tensor]:
        f = torch.diag(torch.exp(torch.tensor([step, side, side], dtype=torch.float64))) @ state
        f = law.project(f, dt)
        stress = law.stress(f)[0]
        return float(stress[1, 1] + stress[2, 2]) / 2, f, stress

    width = abs(step)
    low, high = tried(-0.5 * step - width), tried(-0.5 * step + width)
    ends = [-0.5 * step - width, -0.5 * step + width]
    while low[0] * high[0] > 0 and width < 0.05:
        width *= 2
        ends = [-0.5 * step - width, -0.5 * step + width]
        low, high = tried(ends[0]), tried(ends[1])
    best = min(low, high, key=lambda t: abs(t[0]))
    if low[0] * high[0] >= 0:
        return best[1], best[2]
    a, b, value_a, value_b = ends[0], ends[1], low[0], high[0]
    tolerance = 1e-7 * (abs(value_a) + abs(value_b))
    for _ in range(25):
        middle = (a * value_b - b * value_a) / (value_b - value_a)
        best = tried(middle)
        if abs(best[0]) <= tolerance:
            break
        if best[0] * value_b < 0:
            a, value_a = b, value_b
        else:
            value_a /= 2
        b, value_b = middle, best[0]
    return best[1], best[2]


def kept_shear(law: Law, shear: float, log_volume: float, hold: float) -> float:
    """The share of a small ``shear``, put on at once at ln J = ``log_volume``, that is elastic after ``hold`` [s]."""
    law = in_float64(law)
    start = simple_shear(np.array([shear]), log_volume)
    with torch.no_grad():
        after = start
        for _ in range(10):
            after = law.project(after, hold / 10)
    return float(deviatoric_strain(after)[0] / deviatoric_strain(start)[0])


def relaxation_time(law: Law, shear: float, log_volume: float = 0.0, longest: float = 10.0) -> float | None:
    """Time [s] until the stress of a ``shear``, put on at once and held, falls to 1/e, or None."""
    law = in_float64(law)
    state, time, step = simple_shear(np.array([shear]), log_volume), 0.0, 1e-6
    with torch.no_grad():
        before = first = float(law.stress(state)[0, 0, 1])
        while time < longest and first > 0:
            state = law.project(state, step)
            now = float(law.stress(state)[0, 0, 1])
            if now <= first / np.e:
                share = 1.0 if now <= 0 else np.log(before * np.e / first) / np.log(before / now)
                return time + step * float(share)
            before, time, step = now, time + step, step * 1.15
    return None
