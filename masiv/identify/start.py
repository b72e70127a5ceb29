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
from masiv.identify.problem import Problem
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState
from masiv.pretraining.pretrain import MATERIALS, pretrained_path
from masiv.progress import Progress
from masiv.workers import Workers, unwrap

MODULI = (3e3, 1e4, 3e4, 1e5, 3e5)
"""P-wave moduli tried [Pa at 1000 kg/m^3]: waves of 1.7 to 17 m/s, from what sags at once to what hardly deforms in a
throw."""
STIFFEST = 10 * MODULI[-1]
"""No start is stiffer: a motion without a blow tells nothing from there on, and the substeps would be too many."""
FLUID = "honey"
"""A viscous fluid, which needs no teaching: constants. (The pretrained water has no viscosity.)"""
SEARCHED = {"jelly": (0.5, 0, 0, 0), FLUID: (0.5, 0, 0, 0.7), "sand": (0.5, 0.7, 0, 0)}
FLOWS = 0.5, 0, 0.7, 0
"""First steps of a simplex search in the logarithms of ``NeuralLaw.scales``, 0 where one is left to the fit: few
particles on a coarse grid are another model, and a search over all four makes up for it with the material."""
REFINED = 3
"""Materials that are searched further: a plastic one may be far off at every stiffness, until its yield strain is."""
DIVERGED = 1e3
ELASTIC = "jelly"
TELLS = 1.1
"""A start that flows must be nearer than the elastic one by this factor. Few particles tell no finer, and a yield that
the motion does not reach would be invented: the body breaks there as soon as a prediction stretches it farther."""


@dataclass(frozen=True, eq=False)
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


def choose_start(
    problem: Problem, motion: InitialState, progress: Progress, workers: Workers | None = None
) -> list[Start]:
    """Candidates, best first: each material at each of ``MODULI``, then contacts and a simplex search over scales for
    most; the elastic one counts as the better where another is hardly nearer (``TELLS``).

    problem: with few particles. Rollouts run side by side in ``workers``, and give the same to the bit in whichever.
    Raises MasivError where every candidate diverges.
    """
    config, workers = problem.config, workers or Workers()
    materials = [*MATERIALS, FLUID] if config.start == "auto" else [config.start]
    contacts = ["sticky", "release"] if config.contact == "auto" else [config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    density = problem.scene.density / 1000
    moduli = [modulus * density for modulus in MODULI]
    if compared(problem):
        _ = problem.blob_size, problem.paint  # found here once, or each process would find its own
    found = map(unwrap, workers.map(_errors, [(problem, motion, name, contacts[0], moduli) for name in materials]))
    best: dict[str, tuple[float, float]] = {}
    for done, (name, errors) in enumerate(zip(materials, found, strict=True)):
        best[name] = min(zip(errors, moduli, strict=True))
        progress("identify: start", done + 1, len(materials), f"{name}, {contacts[0]}: {said(best[name][0])}")
    if min(best.values())[0] >= DIVERGED:
        raise MasivError("identify: every starting law diverges; check the scene's ground, gravity and units")
    ranked = sorted(best, key=lambda name: best[name])[:REFINED]
    longest_first = sorted(ranked, key=lambda name: -_effort(name, best[name][1]))
    searched = workers.map(_searched, [(problem, motion, name, contacts, *best[name]) for name in longest_first])
    starts = {}
    for done, (name, (contact, logs, error)) in enumerate(zip(longest_first, map(unwrap, searched), strict=True)):
        starts[name] = Start(name, contact, with_scales(_law(name), best[name][1], logs), error)
        progress("identify: start", done + 1, len(ranked), f"{name}, {contact}: {said(error)}")
    return best_first([starts[name] for name in ranked])


def best_first(starts: Sequence[Start]) -> list[Start]:
    """``starts`` by their errors, the elastic one with an advantage of ``TELLS``."""
    return sorted(starts, key=lambda start: start.error * (1.0 if start.material == ELASTIC else TELLS))


def said(error: float) -> str:
    """An error for people."""
    return "diverges" if error >= DIVERGED else f"objective {error:.3f}"


def _errors(problem: Problem, motion: InitialState, name: str, contact: str, moduli: Sequence[float]) -> list[float]:
    """Of several moduli at once: another process reads the pictures for each task anew."""
    return [_error(problem, motion, name, contact, modulus) for modulus in moduli]


def _searched(
    problem: Problem, motion: InitialState, name: str, contacts: Sequence[str], error: float, modulus: float
) -> tuple[str, tuple[float, ...], float]:
    """The best of ``contacts``, and logarithms of factors of the scales and the error after a simplex search from a
    candidate, whose ``error`` is that of the first contact."""
    others = [(_error(problem, motion, name, contact, modulus), contact) for contact in contacts[1:]]
    error, contact = min([(error, contacts[0]), *others])
    steps = np.array(SEARCHED.get(name, FLOWS))
    moved = np.flatnonzero(steps)

    def logs(point: np.ndarray) -> tuple[float, ...]:
        every = np.zeros(len(steps))
        every[moved] = point
        return tuple(float(log) for log in every)

    def searched(point: np.ndarray) -> float:
        return _error(problem, motion, name, contact, modulus, logs(point)) if point.any() else error

    simplex = np.vstack([np.zeros(len(moved)), np.diag(steps[moved])])
    found = minimize(
        searched, simplex[0], method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 12 * len(moved), "xatol": 0.02, "fatol": 1e-4},
    )  # fmt: skip
    return contact, logs(found.x), float(found.fun)


def _effort(name: str, modulus: float) -> float:
    """How long ``_searched`` takes, beside others: rollouts times substeps, which grow with the speed of sound."""
    return np.count_nonzero(SEARCHED.get(name, FLOWS)) * math.sqrt(modulus)


@functools.lru_cache
def _law(name: str) -> NeuralLaw:
    if name == FLUID:
        return NeuralLaw.maxwell(shear_modulus=1e4, bulk_modulus=1e5, relaxation_time=5e-3)
    return load_law(pretrained_path(name))


@torch.no_grad()
def _error(
    problem: Problem, motion: InitialState, name: str, contact: str, modulus: float, logs: tuple[float, ...] = ()
) -> float:
    scaled = with_scales(_law(name), modulus, logs)
    if scaled.wave_modulus() > STIFFEST * problem.scene.density / 1000:
        return DIVERGED
    try:
        return objective(problem, problem.run(scaled, motion, contact, problem.frames))
    except InputError:
        raise
    except MasivError:  # it diverges, or is too stiff for any substep
        return DIVERGED
