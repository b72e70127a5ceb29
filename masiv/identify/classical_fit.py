"""Parameters of a classical law, velocity, spin and ground height by least squares through rollouts: the baselines.

Coarse search over the law's scales and the contact, Gauss-Newton on few particles over a growing horizon, then
chord steps on all particles, each to paths, or with the pictures beside them. No adjoint is needed, so any law will do.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError, NonFiniteError
from masiv.identify.geometry_loss import mean_distance
from masiv.identify.misfit import Misfit
from masiv.identify.objective import objective
from masiv.identify.problem import PathResidual, Problem
from masiv.inference.least_squares import (
    Estimate,
    clipped_step,
    covariance,
    gauss_newton,
)
from masiv.inference.noise_model import effective_samples
from masiv.inference.robust import soft_l1_sum, soft_l1_weight
from masiv.materials.classical import ClassicalLaw
from masiv.models.families import FAMILIES, Family, law_of
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.models.parameters import Parameter
from masiv.progress import Progress

RECONSIDERED = 3
"""Candidates of the coarse search that are also tried with the other contacts."""
LEAST_GAIN = 1e-3
"""A fit goes on while a step lowers the cost by this share."""
CHORD_STEPS = 4
FURTHER = 3
ALL = "all particles"


@dataclass
class FamilyFit:
    """What a family makes of a motion. values and stderr: law and throw (simulation frame), in each one's unit.

    error_m: mean distance to the trajectories over all frames. mean_square [m^2] and samples: of the residual and how
    many independent ones it is worth. stage: how far the fit is (0 searched, 1 to 3 fitted on few particles, 4 on all).
    """

    kind: str
    contact: str
    values: dict[str, float]
    error_m: float = math.inf
    stderr: dict[str, float] = field(default_factory=dict)
    mean_square: float = math.inf
    samples: int = 0
    rollouts: int = 0
    stage: int = 0

    @property
    def law(self) -> ClassicalLaw:
        law = law_of(FAMILIES[self.kind], self.values)
        law.stderr = {name: self.stderr[name] for name in law.values if name in self.stderr}
        return law

    @property
    def motion(self) -> InitialState:
        return InitialState.of_values(self.values)

    def state(self) -> dict[str, Any]:
        """Plain values, as a checkpoint keeps them."""
        return asdict(self)


def search(problem: Problem, family: Family, motion: InitialState, progress: Progress, *, pictures: bool) -> FamilyFit:
    """The best of ``Family.candidates``, each with the contact that the configuration names, or the best ones with
    each, by their paths, or, as the starts of a neural law, by these and the pictures. Raises MasivError where all
    diverge."""
    contacts = ["sticky", "release"] if problem.config.contact == "auto" else [problem.config.contact]
    if problem.scene.ground is None:
        contacts = ["none"]
    throw = {p.name: p.start for p in initial_state_parameters(motion, problem.ground_range)}
    candidates = family.candidates()
    extra = (len(contacts) - 1) * min(RECONSIDERED, len(candidates))
    found: list[tuple[float, int, str, float]] = []

    def tried(index: int, contact: str) -> None:
        values = {**candidates[index], **throw}
        try:
            field = PathResidual(problem, family, contact, problem.frames).field(values)
            distance = mean_distance(field)
            moved = torch.from_numpy(field).float() + problem.targets[: len(field)]
            error = objective(problem, moved) if pictures else distance
        except NonFiniteError:
            error = distance = math.inf
        found.append((error, index, contact, distance))
        note = "diverges" if math.isinf(error) else f"{1e3 * distance:.0f} mm"
        progress(f"identify: {family.kind} search", len(found), len(candidates) + extra, note)

    for index in range(len(candidates)):
        tried(index, contacts[0])
    for _, index, *_ in sorted(found)[:RECONSIDERED]:
        for contact in contacts[1:]:
            tried(index, contact)
    error, index, contact, distance = min(found)
    if math.isinf(error):
        raise MasivError(
            f"identify: every starting {family.kind} law diverges; check the scene's ground, gravity and units"
        )
    return FamilyFit(family.kind, contact, {**candidates[index], **throw}, distance, rollouts=len(found))


def fit_family(
    kind: str,
    coarse: Problem,
    motion: InitialState,
    first_frames: int,
    checkpoint: Checkpoint,
    progress: Progress,
    *,
    share: float = 1.0,
    pictures: bool = False,
) -> FamilyFit:
    """``kind`` fitted on few particles. Goes on from, and saves after each stage to, ``checkpoint`` under its name.

    share: of the rollouts that the configuration allows a stage. pictures: fit these, too, see ``Misfit``. Raises
    MasivError where every start diverges.
    """
    family = FAMILIES[kind].scaled(coarse.scene.density)
    saved = (checkpoint.load() or {}).get(kind)
    if saved is None:
        found = search(coarse, family, motion, progress, pictures=pictures)
        keep(checkpoint, found)
    else:
        found = FamilyFit(**saved)
    middle = min(coarse.frames, max(first_frames, (coarse.frames + 1) // 2))
    budget = max(2, round(share * coarse.config.family_rollouts))
    for stage, frames in ((1, middle), (2, coarse.frames)):
        if found.stage < stage:
            found = _stage(coarse, family, found, frames, stage, budget, progress, pictures)
            keep(checkpoint, found)
    return found


def fit_further(found: FamilyFit, coarse: Problem, progress: Progress, *, pictures: bool = False) -> FamilyFit:
    """``found``, whose fit was shortened, fitted to all frames once more from where it ended."""
    if found.stage >= FURTHER:
        return found
    family = FAMILIES[found.kind].scaled(coarse.scene.density)
    return _stage(coarse, family, found, coarse.frames, FURTHER, coarse.config.family_rollouts, progress, pictures)


def keep(checkpoint: Checkpoint, found: FamilyFit, name: str | None = None) -> None:
    checkpoint.save({**(checkpoint.load() or {}), name or found.kind: found.state()})


def _stage(
    problem: Problem,
    family: Family,
    found: FamilyFit,
    frames: int,
    stage: int,
    budget: int,
    progress: Progress,
    pictures: bool,
) -> FamilyFit:
    """Gauss-Newton over ``frames`` from what was found."""
    label = f"identify: {found.kind} fit, {frames} frames"
    misfit = Misfit(problem, family, found.contact, frames, pictures=pictures)
    done = 0

    def residual(values: dict[str, float]) -> np.ndarray:
        nonlocal done
        done += 1
        paths, squared = misfit(values)
        progress(label, min(done, budget), budget, f"{1e3 * mean_distance(paths):.1f} mm")
        return squared

    parameters = _parameters(problem, family, found)
    # What a pixel may be off by is bounded, and most are not off at all: their median says nothing.
    robust = not misfit.pictures
    estimate = gauss_newton(residual, parameters, max_evaluations=budget, robust=robust, tolerance=LEAST_GAIN)
    found = _updated(problem, found, _of_paths(estimate, misfit), stage)
    progress(label, budget, budget, f"{1e3 * found.error_m:.1f} mm")
    return found


def _of_paths(estimate: Estimate, misfit: Misfit) -> Estimate:
    """What ``estimate`` says of paths, in metres, by which standard errors and information criteria are worked out:
    neighbouring pixels are hardly independent."""
    if not misfit.pictures:
        return estimate
    residual, jacobian = misfit.of_paths(estimate.residual), misfit.of_paths(estimate.jacobian)
    return replace(estimate, residual=residual, jacobian=jacobian, covariance=covariance(jacobian, residual))


def fit_all_particles(
    found: FamilyFit, coarse: Problem, problem: Problem, checkpoint: Checkpoint, progress: Progress,
    *, pictures: bool = False,
) -> FamilyFit:  # fmt: skip
    """Chord steps: the Jacobian of few particles on the residual of the same particles in rollouts of all of them.

    A finer body is a little stiffer and loses less to the grid, which moves the residual more than its derivative.
    Saved to ``checkpoint`` apart from the fit on few particles, which families are compared by.
    """
    saved = (checkpoint.load() or {}).get(f"{found.kind}, {ALL}")
    if saved is not None:
        return FamilyFit(**saved)
    label = f"identify: {found.kind} fit, {ALL}"
    total = CHORD_STEPS + 2
    family = FAMILIES[found.kind].scaled(coarse.scene.density)
    parameters = _parameters(coarse, family, found)
    progress(label, 0, total)
    on_few = Misfit(coarse, family, found.contact, coarse.frames, pictures=pictures)
    chord = gauss_newton(lambda values: on_few(values)[1], parameters, max_evaluations=1, robust=not pictures)
    progress(label, 1, total)
    misfit = Misfit(problem, family, found.contact, problem.frames, pictures=pictures, chosen=coarse.chosen)
    softness = math.inf if pictures else max(1.4826 * float(np.median(np.abs(chord.residual))), 1e-12)
    values, jacobian, scale = found.values, chord.jacobian, 1.0
    best, residual = misfit(values)
    progress(label, 2, total, f"{1e3 * mean_distance(best):.1f} mm")
    for step in range(CHORD_STEPS):
        weight = soft_l1_weight(residual, softness)
        full = np.linalg.lstsq(jacobian * weight[:, None], -residual * weight, rcond=None)[0]
        moved = clipped_step(parameters, values, scale * full)
        try:
            paths, tried = misfit(moved)
            cost, before = (soft_l1_sum(r, softness) for r in (tried, residual))
        except NonFiniteError:
            cost, before = math.inf, 1.0
        if cost < before:
            values, residual, best = moved, tried, paths
            if cost > (1 - LEAST_GAIN) * before:
                break
        else:
            scale *= 0.5
        progress(label, 3 + step, total, f"{1e3 * mean_distance(best):.1f} mm")
    weight = soft_l1_weight(residual, softness)
    spread = covariance(jacobian * weight[:, None], residual * weight)
    estimate = Estimate(values, spread, jacobian, residual, chord.evaluations + CHORD_STEPS + 1, tuple(parameters))
    found = _updated(coarse, found, _of_paths(estimate, misfit), 4)
    found.error_m = mean_distance(best)
    keep(checkpoint, found, f"{found.kind}, {ALL}")
    progress(label, total, total, f"{1e3 * found.error_m:.1f} mm")
    return found


def information_criteria(fits: list[FamilyFit]) -> dict[str, float]:
    """BIC of normal residuals by family, n ln(mean square) + k ln(n), n those of the best; only differences count."""
    samples = max(1, min(fits, key=lambda f: f.mean_square).samples)
    return {f.kind: samples * math.log(max(f.mean_square, 1e-300)) + len(f.values) * math.log(samples) for f in fits}


def ranked(fits: list[FamilyFit]) -> list[FamilyFit]:
    """Best first: of two families that explain as much, the one with fewer parameters."""
    criteria = information_criteria(fits)
    return sorted(fits, key=lambda f: criteria[f.kind])


def _parameters(problem: Problem, family: Family, found: FamilyFit) -> list[Parameter]:
    both = [*family.parameters, *initial_state_parameters(found.motion, problem.ground_range)]
    return [replace(p, start=float(np.clip(found.values[p.name], p.lower, p.upper))) for p in both]


def _updated(problem: Problem, found: FamilyFit, estimate: Estimate, stage: int) -> FamilyFit:
    """``found`` with what ``estimate``, whose residual is of paths [m], says."""
    residual = estimate.residual.reshape(-1, problem.count, 3)
    samples = effective_samples(residual, problem.particles.double().numpy())
    return replace(
        found,
        values=estimate.values,
        stderr=estimate.stderr(samples),
        error_m=mean_distance(residual),
        mean_square=float((residual**2).mean()),
        samples=samples,
        rollouts=found.rollouts + estimate.evaluations,
        stage=stage,
    )
