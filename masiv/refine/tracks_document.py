"""refine.json and refine.npz of a scene of tracks, as the contract of the run folder has them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.files import write_npz
from masiv.inference.model_fit import ModelFit, rms_mm, split
from masiv.models.base import EffectTerm
from masiv.models.clamped_body import BodyRun
from masiv.models.point_mass import PointRun
from masiv.refine.candidates import Candidate
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import reduced_chi
from masiv.refine.pooling import GroupRefined, unlike
from masiv.refine.rounds import Round, like_accepted
from masiv.refine.search import DISCREPANCY_FORCE
from masiv.refine.summary import ADDED, NOTHING, UNEXPLAINED
from masiv.refine.tracks_stage import Refined, run_errors
from masiv.simulation.fitted_twin import place_of

Found = Refined | GroupRefined


def document(found: Found, config: RefineConfig, *, dry_run: bool) -> dict[str, Any]:
    """What was found. Beside the keys of the contract: ``runs``, errors of each; ``bodies``, the verdict on each of a
    group; ``shared``, effects refitted with one strength for all bodies that have them."""
    result = found.result
    first = result.rounds[0] if result.rounds else None
    after = [found.simulation.term(n) for n in result.after.model.effects]
    new = [t for t in after if any(p.name in result.after.stderr for p in t.parameters)]
    observations = found.simulation.observations
    verdict = ADDED if new else NOTHING
    if not new and reduced_chi(result.after, observations) > config.unexplained:
        verdict = UNEXPLAINED
    return {
        "schema": 1,
        "condition": found.condition if isinstance(found, Refined) else None,
        "noise_floor_mm": 1e3 * float(np.mean([e.noise_std for e in observations])),
        "grid_floor_mm": {"fit": 0.0, "held_out": 0.0},
        "residual_over_floor": {
            "before": reduced_chi(result.before, observations),
            "after": reduced_chi(result.after, observations),
        },
        "residual_mm": {"fit": result.before.fit_mm, "held_out": result.before.held_out_mm},
        "candidates": [_candidate(found, c, first) for c in first.candidates] if first else [],
        "accepted": [_accepted(found, term) for term in new],
        "stop_gap": None
        if result.gap is None
        else {
            "effect": DISCREPANCY_FORCE,
            "fit_rmse_mm": result.gap.fit_mm,
            "held_out_rmse_mm": result.gap.held_out_mm,
        },
        "before": _errors(found, found.before),
        "after": _errors(found, found.after),
        "unexplained": _unexplained(found),
        "verdict": "ranked only" if dry_run else verdict,
        "laws": {"before": result.before.model.family.kind, "after": result.after.model.family.kind},
        "law_parameters": {
            p.name: {"value": result.after.values[p.name], "stderr": result.after.stderr[p.name]}
            for p in result.after.model.family.parameters
        },
        "rounds": [_round(found, r) for r in result.rounds],
        "runs": _runs(found),
        "bodies": _bodies(found) if isinstance(found, GroupRefined) else {},
        "shared": _shared(found) if isinstance(found, GroupRefined) else [],
        "next_experiment": None,
        "rollouts": found.simulation.rollouts,
    }


def scope_of(term: EffectTerm) -> str:
    """Whom the term acts on, and whether they share its strength: all, each, or names."""
    return term.name.removeprefix(term.effect).removeprefix("@") or "all"


def named(document: dict[str, Any]) -> dict[str, Any]:
    """``document`` with effects named by their scope too, for people."""

    def entry(row: dict[str, Any]) -> dict[str, Any]:
        scope = row.get("scope") or ", ".join(row.get("bodies", [])) or "all"
        return row if scope == "all" else {**row, "effect": f"{row['effect']} ({scope})"}

    rounds = [{**r, "refits": [entry(t) for t in r["refits"]]} for r in document["rounds"]]
    return {
        **document,
        "candidates": [entry(c) for c in document["candidates"]],
        "accepted": [entry(a) for a in document["accepted"]],
        "rounds": rounds,
    }


def _short(term: EffectTerm, name: str) -> str:
    return name.removeprefix(f"{term.name}.")


def _candidate(found: Found, candidate: Candidate, first: Round | None) -> dict[str, Any]:
    term = found.simulation.term(candidate.effect)
    sizes = [candidate.theta[p.name] for p in term.strengths]
    errors = [candidate.stderr[p.name] for p in term.strengths]
    one = len(sizes) == 1
    return {
        "effect": term.effect,
        "scope": scope_of(term),
        "explained": candidate.explained,
        "theta": sizes[0] if one else math.hypot(*sizes),
        "unit": term.units[term.strengths[0].name],
        "stderr": errors[0] if one else math.hypot(*errors),
        "parameters": {_short(term, n): v for n, v in candidate.theta.items()},
        "confusable_with": first.confusable.get(candidate.effect, []) if first else [],
        "looks_like": effect_named(term.effect).looks_like,
    }


def _accepted(found: Found, term: EffectTerm) -> dict[str, Any]:
    after = found.result.after
    out = {
        "effect": term.effect,
        "bodies": list(term.bodies),
        "theta": {_short(term, p.name): after.values[p.name] for p in term.parameters},
        "stderr": {_short(term, p.name): after.stderr.get(p.name) for p in term.parameters},
        "unit": {_short(term, p.name): term.units[p.name] for p in term.parameters},
        **like_accepted(term.name, found.result.rounds),
    }
    if isinstance(found, Refined) and (place := place_of(found.simulation, term.name, after)) is not None:
        out["place_in_body"] = {"value": list(place), "unit": "m"}
    return out


def _round(found: Found, done: Round) -> dict[str, Any]:
    def row(t) -> dict[str, Any]:
        term = found.simulation.term(t.candidate.effect)
        return {
            "law": t.fitted.model.family.kind,
            "effect": term.effect,
            "scope": scope_of(term),
            "explained": t.candidate.explained,
            "fit_rmse_mm": t.fitted.fit_mm,
            "held_out_rmse_mm": t.fitted.held_out_mm,
            "parameters": {
                _short(term, p.name): {"value": t.fitted.values[p.name], "stderr": t.fitted.stderr.get(p.name)}
                for p in term.parameters
            },
            "information_gain": _gain(done.base, t.fitted),
            "accepted": done.accepted is t,
            "objections": t.reasons,
        }

    base = {"law": done.base.model.family.kind, "effects": list(done.base.model.effects)}
    return {"base": base, "refits": [row(t) for t in done.trials]}


def _gain(before: ModelFit, after: ModelFit) -> float:
    return before.bic(after.samples) - after.bic(after.samples)


def _errors(found: Found, fields: list[np.ndarray]) -> dict[str, Any]:
    fit, rest = split(fields, found.simulation.observations)
    return {
        "fit": {"trajectory_rmse_mm": rms_mm(fit)},
        "held_out": {"trajectory_rmse_mm": rms_mm(rest)} if rest else {},
    }


def _runs(found: Found) -> list[dict[str, Any]]:
    before, after = (run_errors(found.simulation.observations, f) for f in (found.before, found.after))
    return [
        {
            "run": b["run"],
            "use": b["use"],
            "instants": b["instants"],
            "before_mm": b["rmse_mm"],
            "after_mm": a["rmse_mm"],
        }
        for b, a in zip(before, after, strict=True)
    ]


def _unexplained(found: Found) -> dict[str, Any]:
    """What is left, by run, and when it is largest."""
    worst = max(range(len(found.after)), key=lambda k: float(np.abs(found.after[k]).max()))
    run, size = found.simulation.observations[worst], np.linalg.norm(found.after[worst], axis=2)
    instant, marker = np.unravel_index(int(size.argmax()), size.shape)
    return {
        "rmse_mm": rms_mm(found.after),
        "noise_floor_mm": 1e3 * run.noise_std,
        "worst_run": run.name,
        "worst_time_s": float(run.times[instant]),
        "worst_point": int(marker),
        "worst_mm": 1e3 * float(size.max()),
    }


def _bodies(found: GroupRefined) -> dict[str, Any]:
    """What each body lacks."""
    after, simulation = found.result.after, found.simulation
    terms = [simulation.term(n) for n in after.model.effects]
    held = simulation.by_body(after.model, after.values, fitted=False)
    before = simulation.by_body(found.result.before.model, found.result.before.values, fitted=False)
    out = {}
    for body in simulation.bodies:
        own = [t.effect for t in terms if not t.bodies or body in t.bodies]
        out[body] = {
            "verdict": ADDED if own else NOTHING,
            "effects": own,
            "held_out_mm": {"before": before[body], "after": held[body]},
            "objections": found.refused.get(body, []),
        }
    return out


def _shared(found: GroupRefined) -> list[dict[str, Any]]:
    out = []
    for fit in found.shared:
        term = found.simulation.made(fit.effect, fit.bodies)
        p = term.parameters[0]
        out.append({
            "effect": fit.effect, "bodies": list(fit.bodies), "parameter": _short(term, p.name),
            "value": fit.fitted.values[p.name], "stderr": fit.fitted.stderr[p.name], "unit": term.units[p.name],
            "spread_between_bodies": unlike(fit, found.result, found.simulation),
            "held_out_rmse_mm": fit.fitted.held_out_mm, "information_gain": fit.gain,
        })  # fmt: skip
    return out


def save_fields(path: Path, found: Found) -> None:
    """times, observed, before and after (simulated), of each run, named ``observed@run``: (K, M, A) [m, world]."""
    arrays: dict[str, np.ndarray] = {}
    for run, before, after in zip(found.simulation.observations, found.before, found.after, strict=True):
        observed = observed_of(run)
        arrays[f"times@{run.name}"] = run.times
        arrays[f"observed@{run.name}"] = observed
        arrays[f"before@{run.name}"] = observed + before
        arrays[f"after@{run.name}"] = observed + after
    write_npz(path, **arrays)


def observed_of(run: BodyRun | PointRun) -> np.ndarray:
    """(K, M, A) [m, world]."""
    return run.observed[:, None] if run.observed.ndim == 2 else run.observed
