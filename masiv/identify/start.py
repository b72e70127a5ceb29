"""Where the fit starts: the pretrained law, contact and scales whose rollout is nearest to what was observed."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize

from masiv.errors import InputError, MasivError
from masiv.identify.objective import objective
from masiv.identify.pictures import compared
from masiv.identify.problem import Motion, Problem
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.materials.pretrain import MATERIALS, pretrained_path
from masiv.progress import Progress
from masiv.workers import Workers, demanded

MODULI = (3e3, 1e4, 3e4, 1e5, 3e5)
"""P-wave moduli tried [Pa at 1000 kg/m^3]: waves of 1.7 to 17 m/s, from what sags at once to what hardly deforms in a
throw."""
STEPS = (0.5, 1.0, 0.7, 0.7)
"""First steps of the simplex search in the logarithms of ``NeuralLaw.scales``; what is elastic has the first two."""
DIVERGED = 1e3
ELASTIC = "jelly"
TELLS = 1.1
"""A start that flows must be nearer than the elastic one by this factor. Few particles tell no finer, and a yield that
the motion does not reach would be invented: the body breaks there as soon as a prediction stretches it farther."""


@dataclass(frozen=True)
class Start:
    """A law to start from; error: ``objective`` of its rollout with few particles."""

    material: str
    contact: str
    law: NeuralLaw
    error: float


def with_scales(law: NeuralLaw, modulus: float, logs: Sequence[float] = ()) -> NeuralLaw:
    """``law`` with another P-wave modulus [Pa]; then its scales (``NeuralLaw.scales``) times exp(``logs``)."""
    scaled = copy.deepcopy(law)
    with torch.no_grad():
        scaled.log_stress_scale += math.log(modulus / scaled.wave_modulus())
        for scale, log in zip(scaled.scales(), logs, strict=False):
            scale += log
    return scaled


def choose_start(problem: Problem, motion: Motion, progress: Progress, workers: Workers | None = None) -> list[Start]:
    """Candidates, best first: each material at each of ``MODULI``, then simplex search over the scales of two; the
    elastic one counts as the better where another is hardly nearer (``TELLS``).

    problem: with few particles. Rollouts run side by side in ``workers``, and give the same to the bit in whichever.
    Raises MasivError where every candidate diverges.
    """
    config, workers = problem.config, workers or Workers()
    materials = list(MATERIALS) if config.start == "auto" else [config.start]
    contacts = ["sticky", "release"] if config.contact == "auto" else [config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    density = problem.scene.density / 1000
    moduli = [modulus * density for modulus in MODULI]
    kinds = [(name, contact) for name in materials for contact in contacts]
    coarse: list[tuple[float, str, str, float]] = []
    if compared(problem):
        _ = problem.blob_size, problem.paint  # found here once, or each process would find its own
    found = workers.map(_errors, [(problem, motion, *kind, moduli) for kind in kinds])
    for (name, contact), errors in zip(kinds, map(demanded, found), strict=True):
        coarse += [(error, name, contact, modulus) for error, modulus in zip(errors, moduli, strict=True)]
        total = len(kinds) * len(moduli)
        progress("identify: start", len(coarse), total, f"{name}, {contact}: {said(min(errors))}")
    best = {}
    for error, name, contact, modulus in sorted(coarse):
        best.setdefault(name, (error, contact, modulus))
    if min(entry[0] for entry in best.values()) >= DIVERGED:
        raise MasivError("identify: every starting law diverges; check the scene's ground, gravity and units")
    ranked = sorted(best, key=lambda name: best[name][0])[:2]
    starts = []
    searched = workers.map(_searched, [(problem, motion, name, *best[name]) for name in ranked])
    for done, (name, (logs, error)) in enumerate(zip(ranked, map(demanded, searched), strict=True)):
        _, contact, modulus = best[name]
        starts.append(Start(name, contact, with_scales(_pretrained(name), modulus, logs), error))
        progress("identify: start", done + 1, len(ranked), f"{name}: {said(starts[-1].error)}")
    return best_first(starts)


def best_first(starts: Sequence[Start]) -> list[Start]:
    """``starts`` by their errors, the elastic one with an advantage of ``TELLS``."""
    return sorted(starts, key=lambda start: start.error * (1.0 if start.material == ELASTIC else TELLS))


def said(error: float) -> str:
    """An error for people."""
    return "diverges" if error >= DIVERGED else f"objective {error:.3f}"


def _errors(problem: Problem, motion: Motion, name: str, contact: str, moduli: Sequence[float]) -> list[float]:
    """Of several moduli at once: another process reads the pictures for each task anew."""
    return [_error(problem, motion, name, contact, modulus) for modulus in moduli]


def _searched(
    problem: Problem, motion: Motion, name: str, error: float, contact: str, modulus: float
) -> tuple[list[float], float]:
    """Logarithms of factors of the scales, and the error, after a simplex search from a candidate."""
    steps = STEPS[:2] if name == ELASTIC else STEPS

    def searched(logs: np.ndarray) -> float:
        return _error(problem, motion, name, contact, modulus, tuple(logs)) if logs.any() else error

    found = minimize(
        searched,
        np.zeros(len(steps)),
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([np.zeros(len(steps)), np.diag(steps)]), "maxfev": 12 * len(steps),
            "xatol": 0.02, "fatol": 1e-4,
        },
    )  # fmt: skip
    return [float(log) for log in found.x], float(found.fun)


@functools.lru_cache
def _pretrained(name: str) -> NeuralLaw:
    return load_law(pretrained_path(name))


@torch.no_grad()
def _error(
    problem: Problem, motion: Motion, name: str, contact: str, modulus: float, logs: tuple[float, ...] = ()
) -> float:
    scaled = with_scales(_pretrained(name), modulus, logs)
    try:
        return objective(problem, problem.run(scaled, motion, contact, problem.frames))
    except InputError:
        raise
    except MasivError:  # it diverges, or is too stiff for any substep
        return DIVERGED
