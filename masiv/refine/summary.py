"""refine.json: what was found, as the contract of the run folder has it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.inference.model_fit import ModelFit, rms_mm, split
from masiv.models.free_body import GRID_CHANGE, VideoObservation, effect_parameters
from masiv.refine.answer import answer
from masiv.refine.candidates import Candidate
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import reduced_chi
from masiv.refine.rounds import Round, like_accepted
from masiv.refine.search import DISCREPANCY_FORCE
from masiv.refine.stage import Refined

ADDED, NOTHING, UNEXPLAINED = "effect added", "nothing missing", "unexplained residual"


def verdict(found: Refined, config: RefineConfig) -> str:
    """What the search came to."""
    after = found.result.after
    if reduced_chi(after, found.simulation.observations) > config.unexplained:
        return UNEXPLAINED
    return ADDED if after.model.effects else NOTHING


def summary(found: Refined, config: RefineConfig, *, dry_run: bool) -> dict[str, Any]:
    """The document; ``before`` and ``after`` hold the motion's error, pictures are added by whoever has them."""
    result = found.result
    first = result.rounds[0] if result.rounds else None
    proposal = found.proposal
    observations = found.simulation.observations
    observation = observations[0]
    return {
        "schema": 1,
        "noise_floor_mm": 1e3 * observation.noise_std,
        "grid_floor_mm": _grid_floor(observation),
        "grid_share": {
            "before": _grid_share(result.before, observation), "after": _grid_share(result.after, observation)
        },
        "residual_over_floor": {
            "before": reduced_chi(result.before, observations), "after": reduced_chi(result.after, observations)
        },
        "residual_mm": {"fit": result.before.fit_mm, "held_out": result.before.held_out_mm},
        "candidates": [_candidate(c, first) for c in first.candidates] if first else [],
        "accepted": [
            {**_accepted(name, result.after), **like_accepted(name, result.rounds)}
            for name in result.after.model.effects
        ],
        "stop_gap": None if result.gap is None else _stop_gap(result.gap),
        "before": _errors(found, found.before),
        "after": _errors(found, found.after),
        "unexplained": unexplained(found),
        "verdict": "ranked only" if dry_run else verdict(found, config),
        "laws": {"before": result.before.model.family.kind, "after": result.after.model.family.kind},
        "rounds": [_round(r) for r in result.rounds],
        "next_experiment": None if proposal is None else {
            "tells_apart": list(proposal.between),
            "velocity": {"value": proposal.velocity.tolist(), "unit": "m/s"},
            "omega": {"value": proposal.omega.tolist(), "unit": "rad/s"},
            "predicted_difference_mm": proposal.difference_mm,
            "difference_in_this_throw_mm": proposal.present_mm,
        },
        "rollouts": found.simulation.rollouts,
    }  # fmt: skip


def _grid_share(fitted: ModelFit, observation: VideoObservation) -> float | None:
    """How much there is of what finer grids change on average."""
    return fitted.values.get(f"{GRID_CHANGE}@{observation.name}")


def _grid_floor(observation: VideoObservation) -> dict[str, float | None]:
    """By how much one grid more may differ, root mean square [mm] over the fitted and the held-out instants."""
    grid = observation.residual_std**2 - observation.noise_std**2
    rest = grid[observation.fit_count :]
    fit = 1e3 * math.sqrt(max(float(grid[: observation.fit_count].mean()), 0.0))
    return {"fit": fit, "held_out": 1e3 * math.sqrt(max(float(rest.mean()), 0.0)) if len(rest) else None}


def _stop_gap(fitted: ModelFit) -> dict[str, Any]:
    """A smooth force for what is unexplained; in no sense a cause."""
    return {
        **_accepted(DISCREPANCY_FORCE, fitted),
        "fit_rmse_mm": fitted.fit_mm,
        "held_out_rmse_mm": fitted.held_out_mm,
    }


def _candidate(candidate: Candidate, first: Round) -> dict[str, Any]:
    effect = effect_named(candidate.effect)
    own = effect_parameters(effect.name)
    strengths = own[: effect.strengths]
    size = math.sqrt(sum(candidate.theta[p.name] ** 2 for p in strengths))
    one = len(strengths) == 1
    return {
        "effect": candidate.effect,
        "explained": candidate.explained,
        "theta": candidate.theta[strengths[0].name] if one else size,
        "unit": effect.parameters[0].unit,
        "stderr": candidate.stderr[strengths[0].name]
        if one
        else math.sqrt(sum(candidate.stderr[p.name] ** 2 for p in strengths)),
        "parameters": {p.name.split(".")[1]: candidate.theta[p.name] for p in own},
        "confusable_with": first.confusable.get(candidate.effect, []),
        "looks_like": effect.looks_like,
    }


def _accepted(name: str, fitted: ModelFit) -> dict[str, Any]:
    own = effect_parameters(name)
    short = {p.name: p.name.split(".")[1] for p in own}
    return {
        "effect": name,
        "theta": {short[p.name]: fitted.values[p.name] for p in own},
        "stderr": {short[p.name]: fitted.stderr.get(p.name) for p in own},
        "unit": {q.name: q.unit for q in effect_named(name).parameters},
    }


def _round(done: Round) -> dict[str, Any]:
    """The refits that competed, best first."""
    return {
        "base": {"law": done.base.model.family.kind, "effects": list(done.base.model.effects)},
        "refits": [
            {
                "law": t.fitted.model.family.kind,
                "effect": t.candidate.effect,
                "explained": t.candidate.explained,
                "fit_rmse_mm": t.fitted.fit_mm,
                "held_out_rmse_mm": t.fitted.held_out_mm,
                "parameters": {
                    p.name.split(".")[1]: {"value": t.fitted.values[p.name], "stderr": t.fitted.stderr.get(p.name)}
                    for p in effect_parameters(t.candidate.effect)
                },
                "information_gain": done.base.bic(t.fitted.samples) - t.fitted.bic(t.fitted.samples),
                "accepted": done.accepted is t,
                "objections": t.reasons,
            }
            for t in done.trials
        ],
    }


def _errors(found: Refined, fields: list[np.ndarray]) -> dict[str, Any]:
    fit, rest = split(fields, found.simulation.observations)
    return {
        "fit": {"trajectory_rmse_mm": rms_mm(fit)},
        "held_out": {"trajectory_rmse_mm": rms_mm(rest)} if rest else {},
    }


def unexplained(found: Refined) -> dict[str, Any]:
    """What is left of the first throw's residual, and where and when it is largest."""
    observation = found.simulation.observations[0]
    problem = observation.problem
    field = found.after[0]
    size = np.linalg.norm(field, axis=2)
    by_instant = 1e3 * np.sqrt((size**2).mean(1))
    worst = int(by_instant.argmax())
    by_particle = (size**2).mean(0)
    weight = by_particle * (by_particle >= np.quantile(by_particle, 0.9))
    rest = problem.start.double().numpy()
    where = (weight[:, None] * rest).sum(0) / max(weight.sum(), 1e-300)
    return {
        "rmse_mm": 1e3 * float(np.sqrt((size**2).mean())),
        "noise_floor_mm": 1e3 * observation.noise_std,
        "worst_frame": (worst + 1) / problem.samples,
        "worst_frame_rmse_mm": float(by_instant[worst]),
        "rmse_mm_by_instant": by_instant.tolist(),
        "worst_place_at_frame_0_m": problem.axes.points_to_world(where[None])[0].tolist(),
        "worst_place_rmse_mm": 1e3 * float(np.sqrt(by_particle[weight > 0].mean())) if weight.any() else 0.0,
    }


def text(document: dict[str, Any]) -> str:
    """The document for a terminal."""
    before, after = document["before"], document["after"]
    lines = [
        f"noise floor {document['noise_floor_mm']:.1f} mm, a finer grid would change "
        f"{document['grid_floor_mm']['fit']:.1f} mm; residual {document['residual_mm']['fit']:.1f} mm fitted"
        + _held(document["residual_mm"]["held_out"])
    ]
    for c in document["candidates"][:6]:
        lines.append(
            f"  {c['effect']:20s} explains {100 * c['explained']:3.0f} %  {c['theta']:.3g} {c['unit']}"
            + _looks_like(c["confusable_with"])
        )
    for refits in document["rounds"]:
        for r in refits["refits"]:
            why = "accepted" if r["accepted"] else "; ".join(r["objections"]) or "another was better"
            lines.append(
                f"  refit {r['effect']} ({r['law']}): {r['fit_rmse_mm']:.1f} mm{_held(r['held_out_rmse_mm'])}: {why}"
            )
    for a in document["accepted"]:
        values = ", ".join(f"{n} {v:.4g}{_spread(a['stderr'][n])} {a['unit'][n]}" for n, v in a["theta"].items())
        lines.append(f"{a['effect']}: {values}" + _looks_like(a["confusable_with"]))
    lines.append(
        f"before {before['fit']['trajectory_rmse_mm']:.1f} mm{_held(before['held_out'].get('trajectory_rmse_mm'))}, "
        f"after {after['fit']['trajectory_rmse_mm']:.1f} mm{_held(after['held_out'].get('trajectory_rmse_mm'))}"
    )
    gap = document["stop_gap"]
    if gap is not None:
        lines.append(f"a smooth force without a known cause would leave {gap['fit_rmse_mm']:.1f} mm"
                     f"{_held(gap['held_out_rmse_mm'])}: a stop-gap, not an explanation")  # fmt: skip
    n = document["next_experiment"]
    if n is not None:
        lines.append(
            f"{' and '.join(n['tells_apart'])} look alike here; a throw at {_vector(n['velocity'])} m/s with spin "
            f"{_vector(n['omega'])} rad/s would set them {n['predicted_difference_mm']:.0f} mm apart"
        )
    return "\n".join([*lines, answer(document)])


def _looks_like(others: list[str]) -> str:
    return f"  (looks like {', '.join(others)})" if others else ""


def _held(value: float | None) -> str:
    return "" if value is None else f", {value:.1f} mm held out"


def _vector(quantity: dict[str, Any]) -> str:
    return "(" + ", ".join(f"{v:.1f}" for v in quantity["value"]) + ")"


def _spread(error: float | None) -> str:
    return "" if error is None else f" ± {error:.2g}"
