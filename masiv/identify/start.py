"""Where the fit starts: the pretrained law, contact, stiffness and yield strain whose rollout is nearest to the
motion."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize

from masiv.errors import MasivError, NonFiniteError
from masiv.identify.problem import Motion, Problem
from masiv.identify.silhouette import discrepancy
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.materials.pretrain import MATERIALS, pretrained_path
from masiv.progress import Progress

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


def choose_start(problem: Problem, motion: Motion, progress: Progress) -> list[Start]:
    """Candidates, best first: each material at each of ``MODULI``, then simplex search over stiffness and flow strain;
    the elastic one counts as the better where another is hardly nearer (``TELLS``).

    problem: with few particles. Raises MasivError where every candidate diverges.
    """
    config = problem.config
    materials = list(MATERIALS) if config.start == "auto" else [config.start]
    contacts = ["sticky", "release"] if config.contact == "auto" else [config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    laws = {name: load_law(pretrained_path(name)) for name in materials}
    density = problem.scene.density / 1000
    total = len(materials) * len(contacts) * len(MODULI)
    coarse: list[tuple[float, str, str, float]] = []
    for name in materials:
        for contact in contacts:
            for modulus in MODULI:
                error = _error(problem, motion, laws[name], contact, modulus * density, 1.0)
                coarse.append((error, name, contact, modulus * density))
                progress("identify: start", len(coarse), total, f"{name}, {contact}: {said(problem, error)}")
    best = {}
    for error, name, contact, modulus in sorted(coarse):
        best.setdefault(name, (error, contact, modulus))
    if min(entry[0] for entry in best.values()) >= DIVERGED:
        raise MasivError("identify: every starting law diverges; check the scene's ground, gravity and units")
    ranked = sorted(best, key=lambda name: best[name][0])[:2]
    starts = []
    for done, name in enumerate(ranked):
        _, contact, modulus = best[name]
        starts.append(_refined(problem, motion, name, laws[name], contact, modulus))
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


def _refined(problem: Problem, motion: Motion, name: str, law: NeuralLaw, contact: str, modulus: float) -> Start:
    def objective(logs: np.ndarray) -> float:
        return _error(problem, motion, law, contact, modulus * math.exp(logs[0]), math.exp(logs[1]))

    found = minimize(
        objective,
        np.zeros(2),
        method="Nelder-Mead",
        options={"initial_simplex": [[0, 0], [0.5, 0], [0, 0.7]], "maxfev": 24, "xatol": 0.02, "fatol": 1e-4},
    )
    scaled = with_scales(law, modulus * math.exp(found.x[0]), math.exp(found.x[1]))
    return Start(name, contact, scaled, float(found.fun))


@torch.no_grad()
def _error(problem: Problem, motion: Motion, law: NeuralLaw, contact: str, modulus: float, flow: float) -> float:
    scaled = with_scales(law, modulus, flow)
    try:
        return discrepancy(problem, problem.run(scaled, motion, contact, problem.frames))
    except NonFiniteError:
        return DIVERGED
