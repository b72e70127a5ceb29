"""The starting law: the pretrained law, contact and scales whose rollout is nearest to the observed motion.

MASIV chooses one of its pretrained laws by hand, which it needs as a stable initialization; here the motion chooses.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError, MasivError
from masiv.identification.losses.objective import Objective
from masiv.materials.load import load_law
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import InitialState
from masiv.pretraining.pretrain import MATERIALS, pretrained_path
from masiv.progress import Progress
from masiv.workers import Workers, unwrap

START_MODULI = (3e3, 1e4, 3e4, 1e5, 3e5)
"""P-wave moduli that are tried [Pa at 1000 kg/m^3]. Their wave speeds are 1.7 to 17 m/s: from a body that sags at once
to one that hardly deforms when it hits the ground."""
MAX_START_MODULUS = 10 * START_MODULI[-1]
"""Maximum P-wave modulus of a starting law [Pa at 1000 kg/m^3]. A motion without an impact does not determine a higher
one, and it would need too many substeps."""
MAXWELL_FLUID = "maxwell_fluid"
"""A viscous fluid with constant parameters, which needs no pretraining. (The pretrained water has no viscosity.)"""
SIMPLEX_STEPS = {"jelly": (0.5, 0, 0, 0), MAXWELL_FLUID: (0.5, 0, 0, 0.7), "sand": (0.5, 0.7, 0, 0)}
OTHER_SIMPLEX_STEPS = 0.5, 0, 0.7, 0
"""First steps of the simplex search in the logarithms of ``NeuralLaw.scales``; a scale with step 0 is left to the fit.
A coarse body is another model, and a search over all four scales would make up for it with the material."""
SEARCHED_MATERIALS = 3
"""Materials of which the scales are searched. A plastic material may be far off at every stiffness until its yield
strain is right."""
DIVERGED = 1e3
"""Objective of a rollout that diverges."""
ELASTIC = "jelly"
INELASTIC_MARGIN = 1.1
"""Factor by which the objective of an inelastic law must be less than that of the elastic one. Smaller differences at
coarse resolution are discretisation error, and a yield stress that the motion never reaches cannot be identified: the
body would break as soon as a prediction stretches it farther."""


@dataclass(frozen=True, eq=False)
class StartingLaw:
    """A law to start from, and the objective of its rollout with few particles."""

    material: str
    contact: str
    law: NeuralLaw
    objective: float

    def state(self) -> dict[str, Any]:
        """Plain values and tensors, for ``from_state``."""
        return {
            "material": self.material,
            "contact": self.contact,
            "objective": self.objective,
            "width": self.law.width,
            "law": self.law.state_dict(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> StartingLaw:
        law = NeuralLaw(width=state["width"])
        law.load_state_dict(state["law"])
        return cls(state["material"], state["contact"], law, state["objective"])


def with_scales(law: NeuralLaw, modulus: float, log_factors: Sequence[float] = ()) -> NeuralLaw:
    """A copy of ``law`` with P-wave ``modulus`` [Pa] and ``NeuralLaw.scales`` times exp(``log_factors``)."""
    scaled = copy.deepcopy(law)
    with torch.no_grad():
        scaled.log_stress_scale += math.log(modulus / scaled.wave_modulus())
        for scale, log_factor in zip(scaled.scales(), log_factors, strict=False):
            scale += log_factor
    return scaled


def choose_starting_laws(
    objective: Objective,
    initial_state: InitialState,
    progress: Progress,
    workers: Workers | None = None,
    checkpoint: Checkpoint | None = None,
) -> list[StartingLaw]:
    """Starting laws, best first.

    Each material is tried at each of ``START_MODULI``. The contact and the scales of the best materials are searched.
    Rollouts end when the observed body is at rest. objective: of a problem with few particles. Rollouts run in parallel
    in ``workers``; the number of processes changes no bit of the result. checkpoint: keeps what is known of each
    material. Raises MasivError if every rollout diverges.
    """
    config, workers, checkpoint = objective.config, workers or Workers(), checkpoint or Checkpoint(None)
    materials = [*MATERIALS, MAXWELL_FLUID] if config.start == "auto" else [config.start]
    contacts = ["sticky", "release"] if config.contact == "auto" else [config.contact]
    if objective.problem.scene.ground is None:
        contacts = ["none"]
    objective.prepare(objective.problem.moving_frames)  # once, here: each task has a copy of its own
    known: dict[str, dict[str, Any]] = checkpoint.load() or {}
    best, searched = known.setdefault("best_moduli", {}), known.setdefault("searched", {})

    def keep(found: dict[str, Any], name: str, result: Any, count: int, contact: str, error: float) -> None:
        found[name] = result
        checkpoint.save(known)
        progress("identify: start", len(found), count, f"{name}, {contact}: {_note(error)}")

    shared = objective, initial_state
    moduli = [modulus * objective.problem.scene.density / 1000 for modulus in START_MODULI]
    open_tasks = [(name, contacts[0], moduli) for name in materials if name not in best]
    results = map(unwrap, workers.map(_best_modulus, open_tasks, shared=shared))
    for (name, contact, _), result in zip(open_tasks, results, strict=True):
        keep(best, name, result, len(materials), contact, result[0])
    if min(best.values())[0] >= DIVERGED:
        raise MasivError("identify: every starting law diverges; check the scene's ground, gravity and units")

    ranked = sorted(materials, key=lambda name: best[name])[:SEARCHED_MATERIALS]
    slowest_first = sorted(ranked, key=lambda name: -search_cost(name, best[name][1]))
    tasks = [(name, contacts, *best[name]) for name in slowest_first if name not in searched]
    results = map(unwrap, workers.map(_search_scales, tasks, shared=shared))
    for (name, *_), result in zip(tasks, results, strict=True):
        keep(searched, name, result, len(ranked), result[0], result[2])
    starts = []
    for name in ranked:
        contact, log_factors, error = searched[name]
        starts.append(StartingLaw(name, contact, with_scales(_law(name), best[name][1], log_factors), error))
    return rank_starting_laws(starts)


def rank_starting_laws(starts: Sequence[StartingLaw]) -> list[StartingLaw]:
    """``starts`` by their objectives; that of an inelastic law counts ``INELASTIC_MARGIN`` times."""
    return sorted(starts, key=lambda s: s.objective * (1.0 if s.material == ELASTIC else INELASTIC_MARGIN))


def _note(error: float) -> str:
    """An objective as the progress shows it."""
    return "diverges" if error >= DIVERGED else f"objective {error:.3f}"


def _best_modulus(
    objective: Objective, initial_state: InitialState, name: str, contact: str, moduli: Sequence[float]
) -> tuple[float, float]:
    """The least objective () of a material at ``moduli`` [Pa], and its modulus."""
    return min((objective_of_start(objective, initial_state, name, contact, modulus), modulus) for modulus in moduli)


def _search_scales(
    objective: Objective,
    initial_state: InitialState,
    name: str,
    contacts: Sequence[str],
    error: float,
    modulus: float,
) -> tuple[str, tuple[float, ...], float]:
    """The best of ``contacts``, then a simplex search (Nelder & Mead 1965) over the scales of a material.

    error: the objective with the first contact. Returns the contact, the log factors of the scales, the objective.
    """
    others = [(objective_of_start(objective, initial_state, name, c, modulus), c) for c in contacts[1:]]
    error, contact = min([(error, contacts[0]), *others])
    steps = np.array(SIMPLEX_STEPS.get(name, OTHER_SIMPLEX_STEPS))
    free = np.flatnonzero(steps)

    def log_factors(point: np.ndarray) -> tuple[float, ...]:
        every = np.zeros(len(steps))
        every[free] = point
        return tuple(float(log) for log in every)

    def cost(point: np.ndarray) -> float:
        if not point.any():
            return error
        return objective_of_start(objective, initial_state, name, contact, modulus, log_factors(point))

    simplex = np.vstack([np.zeros(len(free)), np.diag(steps[free])])
    result = minimize(
        cost, simplex[0], method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 12 * len(free), "xatol": 0.02, "fatol": 1e-4},
    )  # fmt: skip
    return contact, log_factors(result.x), float(result.fun)


def search_cost(name: str, modulus: float) -> float:
    """Relative time of the search over the scales of a material: rollouts times substeps, which grow with the wave
    speed."""
    return np.count_nonzero(SIMPLEX_STEPS.get(name, OTHER_SIMPLEX_STEPS)) * math.sqrt(modulus)


@functools.lru_cache
def _law(name: str) -> NeuralLaw:
    if name == MAXWELL_FLUID:
        return NeuralLaw.maxwell(shear_modulus=1e4, bulk_modulus=1e5, relaxation_time=5e-3)
    law = load_law(pretrained_path(name))
    assert isinstance(law, NeuralLaw)
    return law


@torch.no_grad()
def objective_of_start(
    objective: Objective,
    initial_state: InitialState,
    name: str,
    contact: str,
    modulus: float,
    log_factors: tuple[float, ...] = (),
) -> float:
    """The objective () of a rollout of a material with P-wave ``modulus`` [Pa] and scales times exp(``log_factors``).

    ``DIVERGED`` if it diverges or is stiffer than ``MAX_START_MODULUS``. Raises InputError.
    """
    problem, law = objective.problem, with_scales(_law(name), modulus, log_factors)
    if law.wave_modulus() > MAX_START_MODULUS * problem.scene.density / 1000:
        return DIVERGED
    try:
        return objective.evaluate(problem.run(law, initial_state, contact, problem.moving_frames))
    except InputError:
        raise
    except MasivError:  # it diverges, or is too stiff for any substep
        return DIVERGED
