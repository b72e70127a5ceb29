"""What a motion determines of a law: the strains that it excited, and its sensitivity to each property of the law."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.characterization.curves import moduli_at_rest
from masiv.errors import InputError, NonFiniteError
from masiv.local_gradient import local_gradients
from masiv.materials.classical import ClassicalLaw
from masiv.materials.law import Law
from masiv.materials.measures import deviatoric_strain
from masiv.materials.neural import NeuralLaw, output_layer

if TYPE_CHECKING:
    from masiv.mpm.state import State

NEIGHBOURS, MAX_SAMPLES = 12, 1500
"""Particles of a neighbourhood, and neighbourhoods whose deformation is measured."""
PERTURBATION = 1.1
"""Factor of the finite difference: 10 %."""
MIN_EXCITED = 0.1
"""A property is excited if 10 % of it move the body by at least this fraction of the fit's error."""


@dataclass(frozen=True)
class Excited:
    """Over particles and frames: 1st and 99th percentile of the elastic equivalent deviatoric Hencky strain, of the
    total one since frame 0, and of the elastic ln J; 90th percentile of the deviatoric strain rate [1/s]."""

    elastic_strain: tuple[float, float]
    strain: tuple[float, float]
    log_volume: tuple[float, float]
    rate: float


@dataclass(frozen=True)
class Sensitivity:
    """Of a property of a law. moved_mm: RMS displacement [mm] over particles and frames for 10 % more of it; None if
    the law lacks it or the motion diverged.

    stderr_percent: from the fit's error, if all excited properties are fitted and the initial motion is known. None if
    the property is not excited or cannot be distinguished from another.
    """

    name: str
    moved_mm: float | None
    excited: bool
    stderr_percent: float | None


def excited_range(states: Iterable[State]) -> Excited:
    """The range of strains of a rollout; states: one a frame. Raises InputError if there is no frame after frame 0."""
    elastic, whole, volume, rates = [], [], [], []
    rest, index = None, None
    for state in states:
        if rest is None or index is None:
            rest = state.position.double().numpy()
            chosen = np.linspace(0, len(rest) - 1, min(MAX_SAMPLES, len(rest))).round().astype(int)
            index = cKDTree(rest).query(rest[chosen], k=min(NEIGHBOURS, len(rest)))[1]
            continue
        gradient = state.trial_gradient.double()
        elastic.append(deviatoric_strain(gradient))
        volume.append(torch.log(torch.linalg.det(gradient)))
        whole.append(deviatoric_strain(_total_gradient(rest[index], state.position.double().numpy()[index])))
        rate = 0.5 * (state.affine_velocity + state.affine_velocity.mT).double()
        rate = rate - rate.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3).double()
        rates.append((2 / 3) ** 0.5 * rate.norm(dim=(1, 2)))
    if not elastic:
        raise InputError("a material is described from at least two frames of its motion")

    def span(parts: list[torch.Tensor]) -> tuple[float, float]:
        low, high = np.percentile(torch.cat(parts).numpy(), [1, 99])
        return float(low), float(high)

    return Excited(span(elastic), span(whole), span(volume), float(np.percentile(torch.cat(rates).numpy(), 90)))


def _total_gradient(rest: np.ndarray, now: np.ndarray) -> torch.Tensor:
    """``local_gradients`` (M, 3, 3) of neighbourhoods that are not turned inside out."""
    f = torch.as_tensor(local_gradients(rest, now))
    return f[torch.linalg.det(f) > 0]


def perturbed(law: Law, factor: float = PERTURBATION) -> dict[str, Law]:
    """``law`` with one property at a time multiplied by ``factor``, by name; the properties that its kind has."""
    if isinstance(law, NeuralLaw):
        return {
            "shear modulus": _changed(law, lambda new: output_layer(new.elastic).bias[:2].add_(math.log(factor))),
            "bulk modulus": _changed(law, lambda new: new.log_bulk_ratio.add_(math.log(factor))),
            "flow strain": _changed(law, lambda new: new.log_flow_strain.add_(math.log(factor))),
            "relaxation time": _changed(law, lambda new: output_layer(new.plastic).bias.sub_(math.log(factor))),
        }
    if not isinstance(law, ClassicalLaw):
        return {}
    values = {name: float(value.detach()) for name, value in law.values.items()}
    changed: dict[str, dict[str, float]] = {}
    if {"youngs_modulus", "poissons_ratio"} <= values.keys():
        shear, bulk = _shear_and_bulk(values)
        if law.kind != "water":
            changed["shear modulus"] = _elastic(factor * shear, bulk)
        changed["bulk modulus"] = _elastic(shear, factor * bulk)
        if law.kind == "water":  # its one modulus is Lamé's lambda
            changed["bulk modulus"] = {"youngs_modulus": factor * values["youngs_modulus"]}
    for name, value in values.items():
        if name not in ("youngs_modulus", "poissons_ratio"):
            changed[name.replace("_", " ")] = {name: factor * value}
    return {name: ClassicalLaw(law.kind, **(values | change)) for name, change in changed.items()}


def _changed(law: NeuralLaw, change: Callable[[NeuralLaw], object]) -> NeuralLaw:
    new = copy.deepcopy(law)
    with torch.no_grad():
        change(new)
    return new


def _shear_and_bulk(values: dict[str, float]) -> tuple[float, float]:
    young, poisson = values["youngs_modulus"], values["poissons_ratio"]
    return young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))


def _elastic(shear: float, bulk: float) -> dict[str, float]:
    return {
        "youngs_modulus": 9 * bulk * shear / (3 * bulk + shear),
        "poissons_ratio": (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear)),
    }


def sensitivities(
    reroll: Callable[[Law], np.ndarray], law: Law, *, error_mm: float, residual: np.ndarray | None = None
) -> list[Sensitivity]:
    """How well a motion determines the properties of ``law``.

    reroll: a law -> positions (T, Q, 3) [m] of its motion, frame 0 included. error_mm: RMS error of the fit over
    particles. residual (T - 1, Q, 3) [m]: the participation ratio of its singular values is the number of independent
    data; without it, each frame counts as one.
    """
    base = reroll(law)[1:].astype(np.float64)
    moved: dict[str, np.ndarray | None] = {}
    for name, other in perturbed(law).items():
        try:
            moved[name] = 1e3 * (reroll(other)[1:] - base) * _to_ten_percent(law, other, name)
        except NonFiniteError:
            moved[name] = None
    size = {name: None if d is None else float(np.sqrt((d**2).sum(2).mean())) for name, d in moved.items()}
    excited_names = [name for name, value in size.items() if value is not None and value >= MIN_EXCITED * error_mm]
    stderr = _standard_errors([moved[name] for name in excited_names], error_mm, _independent(residual, len(base)))
    by_name = dict(zip(excited_names, stderr, strict=True))
    return [Sensitivity(name, value, name in excited_names, by_name.get(name)) for name, value in size.items()]


def _to_ten_percent(law: Law, other: Law, name: str) -> float:
    """Factor that scales the change to 10 %: outputs of the networks are bounded, so that less than 10 % may arrive."""
    if name not in ("shear modulus", "bulk modulus") or not isinstance(law, NeuralLaw):
        return 1.0
    which = 0 if name == "shear modulus" else 1
    made = math.log(moduli_at_rest(other)[which] / moduli_at_rest(law)[which])
    return math.log(PERTURBATION) / made if made > 1e-3 else 1.0


def _independent(residual: np.ndarray | None, frames: int) -> float:
    if residual is None or not np.any(residual):
        return float(frames)
    power = np.linalg.svd(residual.reshape(len(residual), -1), compute_uv=False) ** 2
    return float(power.sum() ** 2 / (power**2).sum())


def _standard_errors(moved: list[np.ndarray | None], error_mm: float, independent: float) -> list[float | None]:
    columns = np.stack([d.ravel() for d in moved if d is not None], 1) if moved else np.zeros((1, 0))
    gram = 3 * columns.T @ columns / max(len(columns), 1)  # mean over particles of the dot product
    scale = np.sqrt(np.diag(gram))
    if len(gram) == 0:
        return []
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    distinguished = values > 1e-4
    # A direction that the data do not determine leaves the properties in it unknown.
    unknown = (vectors[:, ~distinguished] ** 2).sum(1) > 0.05
    inverse = (vectors[:, distinguished] / values[distinguished]) @ vectors[:, distinguished].T
    stderr = 10 * error_mm * np.sqrt(np.diag(inverse) / independent) / scale
    return [None if u else float(e) for u, e in zip(unknown, stderr, strict=True)]
