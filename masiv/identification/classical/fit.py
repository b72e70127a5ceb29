"""Parameters of a classical law, initial velocity, spin and ground height by least squares through rollouts.

The laws are those of PAC-NeRF (Li et al. 2023) and GIC (Cai et al. 2024), the material-specific baselines of MASIV. A
coarse search over the law's scales and the contact comes first, then Gauss-Newton with few particles over a growing
horizon, then chord steps with all particles. Derivatives are finite differences, so the law needs no adjoint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from masiv.checkpoint import Checkpoint
from masiv.errors import NonFiniteError
from masiv.identification.classical.residuals import JointResidual
from masiv.identification.classical.search import search_family
from masiv.identification.losses.geometry import mean_distance
from masiv.identification.losses.objective import Objective
from masiv.inference.least_squares import Estimate, clipped_step, covariance, gauss_newton, with_start_values
from masiv.inference.noise_model import effective_samples
from masiv.inference.robust import NORMAL_MAD, soft_l1_sum, soft_l1_weight
from masiv.materials.classical import ClassicalLaw
from masiv.models.families import FAMILIES, Family, law_of
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState, initial_state_parameters
from masiv.models.parameters import Parameter
from masiv.progress import Progress

MIN_COST_DECREASE = 1e-3
"""A fit continues while a step lowers the cost by this fraction."""
CHORD_STEPS = 4
SEARCHED, HALF_HORIZON, ALL_FRAMES, FURTHER, ALL_PARTICLES = range(5)
"""How far a fit is, ``FamilyFit.stage``: the coarse search; few particles over half of the frames, over all, over all
once more; all particles."""
ALL_PARTICLES_KEY = "all particles"


@dataclass
class FamilyFit:
    """The fit of a law family.

    values and stderr: of law and initial state (simulation frame), each in its unit. error_m: mean distance to the
    trajectories [m] over all frames. mean_square [m^2]: of the residual of the paths; samples: the number of
    independent residuals that it is worth. rollouts: how many the fit took. stage: how far it is.
    """

    kind: str
    contact: str
    values: dict[str, float]
    error_m: float = math.inf
    stderr: dict[str, float] = field(default_factory=dict)
    mean_square: float = math.inf
    samples: int = 0
    rollouts: int = 0
    stage: int = SEARCHED

    @property
    def law(self) -> ClassicalLaw:
        law = law_of(FAMILIES[self.kind], self.values)
        law.stderr = {name: self.stderr[name] for name in law.values if name in self.stderr}
        return law

    @property
    def initial_state(self) -> InitialState:
        return InitialState.of_values(self.values)

    def state(self) -> dict[str, Any]:
        """Plain values, as a checkpoint keeps them."""
        return asdict(self)


def save_fit(checkpoint: Checkpoint, fit: FamilyFit, key: str | None = None) -> None:
    """Add ``fit`` to what ``checkpoint`` holds, under ``key`` or the name of its family."""
    checkpoint.save({**(checkpoint.load() or {}), key or fit.kind: fit.state()})


def fit_family(
    kind: str,
    coarse: Objective,
    initial_state: InitialState,
    first_frames: int,
    checkpoint: Checkpoint,
    progress: Progress,
    *,
    budget_factor: float = 1.0,
    with_images: bool = False,
) -> FamilyFit:
    """The family ``kind`` fitted to the few particles of ``coarse``, from ``initial_state``.

    After each stage the fit is saved to ``checkpoint`` under its name; a resumed fit continues from there.
    budget_factor: of the rollouts that the configuration allows a stage. with_images: see ``JointResidual``. Raises
    MasivError if every start of the search diverges.
    """
    problem = coarse.problem
    family = FAMILIES[kind].scaled(problem.scene.density)
    saved = (checkpoint.load() or {}).get(kind)
    if saved is None:
        best = search_family(coarse, family, initial_state, progress, with_images=with_images)
        fit = FamilyFit(kind, best.contact, best.values, best.error_m, rollouts=best.rollouts)
        save_fit(checkpoint, fit)
    else:
        fit = FamilyFit(**saved)
    half = min(problem.frames, max(first_frames, (problem.frames + 1) // 2))
    budget = max(2, round(budget_factor * coarse.config.family_rollouts))
    for stage, frames in ((HALF_HORIZON, half), (ALL_FRAMES, problem.frames)):
        if fit.stage < stage:
            fit = _gauss_newton(coarse, family, fit, frames, stage, budget, progress, with_images)
            save_fit(checkpoint, fit)
    return fit


def fit_further(fit: FamilyFit, coarse: Objective, progress: Progress, *, with_images: bool = False) -> FamilyFit:
    """A fit with a reduced budget, continued over all frames with the full budget of a stage."""
    if fit.stage >= FURTHER:
        return fit
    family = FAMILIES[fit.kind].scaled(coarse.problem.scene.density)
    budget = coarse.config.family_rollouts
    return _gauss_newton(coarse, family, fit, coarse.problem.frames, FURTHER, budget, progress, with_images)


def _gauss_newton(
    objective: Objective,
    family: Family,
    fit: FamilyFit,
    frames: int,
    stage: int,
    budget: int,
    progress: Progress,
    with_images: bool,
) -> FamilyFit:
    """Gauss-Newton over the first ``frames`` frames from ``fit``, with at most ``budget`` rollouts."""
    label = f"identify: {fit.kind} fit, {frames} frames"
    joint = JointResidual(objective, family, fit.contact, frames, with_images=with_images)
    evaluations = 0

    def residual(values: dict[str, float]) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        paths, vector = joint(values)
        progress(label, min(evaluations, budget), budget, f"{1e3 * mean_distance(paths):.1f} mm")
        return vector

    parameters = _parameters(objective, family, fit)
    # Residuals of pixels are bounded, and most are 0: they need no robust scale, and their median is none.
    estimate = gauss_newton(
        residual, parameters, max_evaluations=budget, robust=not with_images, tolerance=MIN_COST_DECREASE
    )
    fit = _updated(objective.problem, fit, _path_estimate(estimate, joint), stage)
    progress(label, budget, budget, f"{1e3 * fit.error_m:.1f} mm")
    return fit


def _path_estimate(estimate: Estimate, joint: JointResidual) -> Estimate:
    """The part of ``estimate`` that is of paths [m], from which standard errors and information criteria are computed:
    the residuals of neighbouring pixels are hardly independent."""
    if not joint.with_images:
        return estimate
    residual, jacobian = joint.path_part(estimate.residual), joint.path_part(estimate.jacobian)
    return replace(estimate, residual=residual, jacobian=jacobian, covariance=covariance(jacobian, residual))


def fit_all_particles(
    fit: FamilyFit, coarse: Objective, objective: Objective, checkpoint: Checkpoint, progress: Progress,
    *, with_images: bool = False,
) -> FamilyFit:  # fmt: skip
    """``fit`` continued with all particles by chord steps.

    The Jacobian is that of few particles, the residual that of the same particles in rollouts of all of them: a finer
    body is a little stiffer and loses less energy to the grid, which moves the residual more than its derivative. Saved
    to ``checkpoint`` apart from the fit with few particles, by which families are compared.
    """
    key = f"{fit.kind}, {ALL_PARTICLES_KEY}"
    saved = (checkpoint.load() or {}).get(key)
    if saved is not None:
        return FamilyFit(**saved)
    label, total = f"identify: {fit.kind} fit, {ALL_PARTICLES_KEY}", CHORD_STEPS + 2
    family = FAMILIES[fit.kind].scaled(coarse.problem.scene.density)
    parameters = _parameters(coarse, family, fit)
    progress(label, 0, total)
    on_few = JointResidual(coarse, family, fit.contact, coarse.problem.frames, with_images=with_images)
    linear = gauss_newton(lambda values: on_few(values)[1], parameters, max_evaluations=1, robust=not with_images)
    progress(label, 1, total)
    joint = JointResidual(
        objective, family, fit.contact, objective.problem.frames,
        with_images=with_images, chosen=coarse.problem.chosen,
    )  # fmt: skip
    robust_scale = math.inf if with_images else max(NORMAL_MAD * float(np.median(np.abs(linear.residual))), 1e-12)
    values, paths, residual = _chord_steps(
        joint, parameters, fit.values, linear.jacobian, robust_scale,
        lambda step, error_m: progress(label, 2 + step, total, f"{1e3 * error_m:.1f} mm"),
    )  # fmt: skip
    weight = soft_l1_weight(residual, robust_scale)
    spread = covariance(linear.jacobian * weight[:, None], residual * weight)
    evaluations = linear.evaluations + CHORD_STEPS + 1
    estimate = Estimate(values, spread, linear.jacobian, residual, evaluations, tuple(parameters))
    fit = _updated(coarse.problem, fit, _path_estimate(estimate, joint), ALL_PARTICLES)
    fit.error_m = mean_distance(paths)
    save_fit(checkpoint, fit, key)
    progress(label, total, total, f"{1e3 * fit.error_m:.1f} mm")
    return fit


def _chord_steps(
    joint: JointResidual,
    parameters: Sequence[Parameter],
    values: dict[str, float],
    jacobian: np.ndarray,
    robust_scale: float,
    report: Callable[[int, float], None],
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """Gauss-Newton steps with a fixed ``jacobian`` (M, P), halved after one that does not lower the robust cost.

    report: called with the number of the step and the mean distance of the paths [m]. Returns the values, the paths
    (K, N, 3) [m] and the residual vector (M,). Raises NonFiniteError if the first rollout diverges.
    """
    scale = 1.0
    paths, residual = joint(values)
    report(0, mean_distance(paths))
    for step in range(CHORD_STEPS):
        weight = soft_l1_weight(residual, robust_scale)
        full = np.linalg.lstsq(jacobian * weight[:, None], -residual * weight, rcond=None)[0]
        trial = clipped_step(parameters, values, scale * full)
        try:
            trial_paths, trial_residual = joint(trial)
        except NonFiniteError:
            trial_paths, trial_residual = paths, np.full_like(residual, np.inf)
        before, cost = (soft_l1_sum(r, robust_scale) for r in (residual, trial_residual))
        if cost < before:
            values, paths, residual = trial, trial_paths, trial_residual
            if cost > (1 - MIN_COST_DECREASE) * before:
                break
        else:
            scale *= 0.5
        report(1 + step, mean_distance(paths))
    return values, paths, residual


def _parameters(objective: Objective, family: Family, fit: FamilyFit) -> tuple[Parameter, ...]:
    """The parameters of law and initial state, from the values of ``fit``."""
    both = [*family.parameters, *initial_state_parameters(fit.initial_state, objective.ground_range)]
    return with_start_values(both, fit.values)


def _updated(problem: FilmedBody, fit: FamilyFit, estimate: Estimate, stage: int) -> FamilyFit:
    """``fit`` with the values and errors of ``estimate``, whose residual is of paths [m]."""
    residual = estimate.residual.reshape(-1, problem.count, 3)
    samples = effective_samples(residual, problem.particles.double().numpy())
    return replace(
        fit,
        values=estimate.values,
        stderr=estimate.stderr(samples),
        error_m=mean_distance(residual),
        mean_square=float((residual**2).mean()),
        samples=samples,
        rollouts=fit.rollouts + estimate.evaluations,
        stage=stage,
    )
