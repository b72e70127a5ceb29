"""Where the fit starts: the pretrained law, contact, stiffness and yield strain whose rollout is nearest to the
motion."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize

from masiv.errors import MasivError, NonFiniteError
from masiv.identify.objective import discrepancy
from masiv.identify.problem import Motion, Problem
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.materials.pretrain import MATERIALS, pretrained_path
from masiv.progress import Progress
from masiv.workers import Workers, demanded

MODULI = (3e3, 1e4, 3e4, 1e5, 3e5)
"""P-wave moduli tried [Pa at 1000 kg/m^3]: waves of 1.7 to 17 m/s, from what sags at once to what hardly deforms in a
throw."""
DIVERGED = 1e3
ELASTIC = "jelly"
TELLS = 1.1
"""A start that flows must be nearer than the elastic one by this factor. Few particles tell no finer, and a yield that
the motion does not reach would be invented: the body breaks there as soon as a prediction stretches it farther."""


@dataclass(frozen=True)
class Start:
    """A law to start from; error: ``discrepancy`` of its rollout with few particles, [m] or, of silhouettes, [1]."""

    material: str
    contact: str
    law: NeuralLaw
    error: float


def with_scales(law: NeuralLaw, modulus: float, flow_factor: float) -> NeuralLaw:
    """``law`` with another P-wave modulus [Pa] and its flow strain times ``flow_factor``."""
    scaled = copy.deepcopy(law)
    with torch.no_grad():
        scaled.log_stress_scale += math.log(modulus / scaled.wave_modulus())
        scaled.log_flow_strain += math.log(flow_factor)
    return scaled


def choose_start(problem: Problem, motion: Motion, progress: Progress, workers: Workers | None = None) -> list[Start]:
    """Candidates, best first: each material at each of ``MODULI``, then simplex search over stiffness and flow strain;
    the elastic one counts as the better where another is hardly nearer (``TELLS``).

    problem: with few particles. Rollouts run side by side in ``workers``, and give the same to the bit in whichever.
    Raises MasivError where every candidate diverges.
    """
    config, workers = problem.config, workers or Workers()
    materials = list(MATERIALS) if config.start == "auto" else [config.start]
    contacts = ["sticky", "release"] if config.contact == "auto" else [config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    density = problem.scene.density / 1000
    tried = [(name, contact, modulus * density) for name in materials for contact in contacts for modulus in MODULI]
    coarse: list[tuple[float, str, str, float]] = []
    if config.geometry_loss == "none":
        _ = problem.blob_size  # found here once, or each process would find its own
    found = workers.map(_error, [(problem, motion, *candidate, 1.0) for candidate in tried])
    for (name, contact, modulus), error in zip(tried, map(demanded, found), strict=True):
        coarse.append((error, name, contact, modulus))
        progress("identify: start", len(coarse), len(tried), f"{name}, {contact}: {said(problem, error)}")
    best = {}
    for error, name, contact, modulus in sorted(coarse):
        best.setdefault(name, (error, contact, modulus))
    if min(entry[0] for entry in best.values()) >= DIVERGED:
        raise MasivError("identify: every starting law diverges; check the scene's ground, gravity and units")
    ranked = sorted(best, key=lambda name: best[name][0])[:2]
    starts = []
    searched = workers.map(_searched, [(problem, motion, name, *best[name]) for name in ranked])
    for done, (name, (modulus, flow, error)) in enumerate(zip(ranked, map(demanded, searched), strict=True)):
        starts.append(Start(name, best[name][1], with_scales(_pretrained(name), modulus, flow), error))
        progress("identify: start", done + 1, len(ranked), f"{name}: {said(problem, starts[-1].error)}")
    return best_first(starts)


def best_first(starts: Sequence[Start]) -> list[Start]:
    """``starts`` by their errors, the elastic one with an advantage of ``TELLS``."""
    return sorted(starts, key=lambda start: start.error * (1.0 if start.material == ELASTIC else TELLS))


def said(problem: Problem, error: float) -> str:
    """An error for people."""
    if error >= DIVERGED:
        return "diverges"
    return f"silhouettes {error:.3f}" if problem.config.geometry_loss == "none" else f"{1e3 * error:.1f} mm"


def _searched(
    problem: Problem, motion: Motion, name: str, error: float, contact: str, modulus: float
) -> tuple[float, float, float]:
    """P-wave modulus [Pa], factor of the flow strain and error after a simplex search from a candidate."""

    def objective(logs: np.ndarray) -> float:
        if not logs.any():
            return error
        return _error(problem, motion, name, contact, modulus * math.exp(logs[0]), math.exp(logs[1]))

    found = minimize(
        objective,
        np.zeros(2),
        method="Nelder-Mead",
        options={"initial_simplex": [[0, 0], [0.5, 0], [0, 0.7]], "maxfev": 24, "xatol": 0.02, "fatol": 1e-4},
    )
    return modulus * math.exp(found.x[0]), math.exp(found.x[1]), float(found.fun)


@functools.lru_cache
def _pretrained(name: str) -> NeuralLaw:
    return load_law(pretrained_path(name))


@torch.no_grad()
def _error(problem: Problem, motion: Motion, name: str, contact: str, modulus: float, flow: float) -> float:
    scaled = with_scales(_pretrained(name), modulus, flow)
    try:
        return discrepancy(problem, problem.run(scaled, motion, contact, problem.frames))
    except NonFiniteError:
        return DIVERGED
