"""refine.json as lines for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from masiv.inference.model_fit import PARTS
from masiv.refinement.answer import advice, answer, outcome, together
from masiv.refinement.result import RANKED
from masiv.refinement.support import question


def with_scopes(document: Mapping[str, Any]) -> dict[str, Any]:
    """``document`` with effects named by whom they act on, too, for people; their scope is then no more told apart."""

    def named(row: Mapping[str, Any]) -> dict[str, Any]:
        scope = row.get("scope") or "all"
        return dict(row) if scope == "all" else {**row, "effect": f"{row['effect']} ({scope})", "scope": "all"}

    rounds = [{**r, "refits": [named(t) for t in r["refits"]]} for r in document["rounds"]]
    return {
        **document,
        "candidates": [named(c) for c in document["candidates"]],
        "accepted": [named(a) for a in document["accepted"]],
        "rounds": rounds,
    }


def text(document: Mapping[str, Any]) -> str:
    """The document for a terminal."""
    shown = with_scopes(document)
    before, after = shown["before"], shown["after"]
    compared = " (two sets of cameras were compared)" if shown.get("camera_split") else ""
    lines = [
        f"noise floor {shown['noise_floor_mm']:.1f} mm, expected error of the observation "
        f"{shown['observation_error_mm']['fit'] or 0.0:.1f} mm{compared}, a finer grid would change "
        f"{shown['discretization_mm']['fit'] or 0.0:.1f} mm; residual {shown['residual_mm']['fit']:.1f} mm fitted"
        + _validation(shown["residual_mm"]["validation"])
    ]
    for c in shown["candidates"][:6]:
        lines.append(
            f"  {c['effect']:20s} explains {100 * c['explained']:3.0f} %  {c['theta']:.3g} {c['unit']}"
            + _probable(c["probability"])
        )
    lines += [f"  {c['effect']:20s} not ranked: {c['reason']}" for c in shown["not_ranked"]]
    for done in shown["rounds"]:
        lines += [_refit_line(r) for r in done["refits"]]
        lines += [f"  refit {f['effect']} ({f['law']}): {f['reason']}" for f in done["not_fitted"]]
        lines += [
            f"  exchanged {together([x['old']])} for {together([x['new']])}: log Bayes factor "
            f"{x['log_bayes_factor']:.1f}"
            for x in done.get("exchanges", ())
        ]
    for a in shown["accepted"]:
        values = ", ".join(f"{n} {v:.4g}{_plus_minus(a['stderr'][n])} {a['unit'][n]}" for n, v in a["theta"].items())
        lines.append(f"{a['effect']}: {values}" + _looks_like(a["indistinguishable_from"]))
        lines += [
            f"  {name} in the axes of the scene ({', '.join(f'{v:.3g}' for v in q['value'])}) {q['unit']}"
            for name, q in a["world"].items()
            if q["unit"] != "1"
        ]
        if a["carried_weight"] is not None:
            lines.append(f"  {question(a['carried_weight'], a.get('carried_weight_stderr'))}")
    lines.append(f"before {_parts_mm(before)}; after {_parts_mm(after)}")
    force = shown["discrepancy_force"]
    if force is not None:
        lines.append(
            f"a smooth force without a known cause would leave {force['fit_rmse_mm']:.1f} mm"
            f"{_validation(force['validation_rmse_mm'])}: it stands in for the discrepancy and explains nothing"
        )
        lines += _force_lines(force)
    lines += _several_bodies(shown["bodies"], shown["shared"])
    if shown["verdict"] != RANKED:
        lines.append(
            f"probability of no effect {shown['null_probability']:.2g}, of something unknown "
            f"{shown['unknown_probability']:.2g}; a residual as large as that after has a probability of "
            f"{shown['predictive_p']['after']:.2g} if nothing is missing"
        )
        lines += _credible_lines(shown["credible_set"])
        lines += [
            f"test, {name}: {x['rmse_mm']:.1f} mm, expected {x['expected_rmse_mm']:.1f} mm, log density "
            f"{x['log_density']:.1f}"
            for name, x in shown["test"].items()
        ]
    lines += _limit_lines(shown["upper_limits"])
    n = shown["next_experiment"]
    if n is not None:
        lines.append(
            f"{' and '.join(n['distinguishes'])} look alike here; an initial velocity of "
            f"{_vector(n['initial_velocity'])} m/s with a spin of {_vector(n['initial_omega'])} rad/s would set them "
            f"{n['predicted_difference_mm']:.0f} mm apart"
        )
    told = advice(shown)
    lines += [told] if told else []
    lines += [f"problem: {problem}" for problem in shown.get("problems", ())]
    return "\n".join([*lines, answer(shown)])


def _force_lines(force: Mapping[str, Any]) -> list[str]:
    """When, where and which way the force is strongest."""
    peak = force["peak"]
    if peak is None:
        return []
    way = ", ".join(f"{v:.2f}" for v in peak["direction"])
    place = ", ".join(f"{v:.2f}" for v in peak["place"]["value"])
    shares = [f"{100 * s:.0f} % ({what})" for what, s in force["share"].items()
              if s is not None]  # fmt: skip
    return [
        f"  it is strongest at {peak['time']['value']:.2f} s at ({place}) m: {peak['acceleration']['value']:.2g} m/s^2 "
        f"along ({way}); share of the residual {', '.join(shares)}"
    ]


def _refit_line(row: Mapping[str, Any]) -> str:
    errors = f"{row['fit_rmse_mm']:.1f} mm{_validation(row['validation_rmse_mm'])}"
    return f"  refit {row['effect']} ({row['law']}): {errors}: {outcome(row)}"


def _credible_lines(sets: Sequence[Mapping[str, Any]]) -> list[str]:
    """What may act, where that is more than one answer."""
    told = [f"{together(s['effects'])} {s['probability']:.2g}" for s in sets]
    return [f"95 % credible set of the first round: {', '.join(told)}"] if len(told) > 1 else []


def _limit_lines(limits: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is excluded, and what this recording says little of."""
    told = [f"{x['effect']} {x['strength']:.2g} {x['unit']}".strip() for x in limits if x["determined"]]
    open_ = [x["effect"] for x in limits if not x["determined"] and not x["reason"]]
    lines = [f"95 % upper limits: {', '.join(told)}"] if told else []
    lines += [f"this recording says little of {', '.join(open_)}"] if open_ else []
    return [*lines, *(f"no upper limit of {x['effect']}: {x['reason']}" for x in limits if x["reason"])]


def _probable(probability: float | None) -> str:
    return "" if probability is None else f", probability {probability:.2g}"


def _several_bodies(bodies: Mapping[str, Any], shared: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = []
    for name, row in bodies.items():
        held = row["validation_mm"]
        what = ", ".join(row["effects"]) or row["verdict"]
        lines.append(f"  {name:24s} {what:28s} validation {held['before']:.0f} -> {held['after']:.0f} mm")
    for row in shared:
        lines.append(
            f"one {row['parameter'].replace('_', ' ')} for {', '.join(row['bodies'])}: {row['value']:.3g} ± "
            f"{row['stderr']:.2g} {row['unit']}, standard deviation between them {row['std_between_bodies']:.2g}"
        )
    return lines


def _looks_like(others: Sequence[str]) -> str:
    return f"  (looks like {', '.join(others)})" if others else ""


def _validation(value: float | None) -> str:
    return "" if value is None else f", {value:.1f} mm validation"


def _parts_mm(errors: Mapping[str, Any]) -> str:
    words = {"fit": "fitted"}
    known = [(words.get(part, part), errors[part]["trajectory_rmse_mm"]) for part in PARTS if part in errors]
    return ", ".join(f"{value:.1f} mm {word}" for word, value in known)


def _vector(quantity: Mapping[str, Any]) -> str:
    return "(" + ", ".join(f"{v:.1f}" for v in quantity["value"]) + ")"


def _plus_minus(error: float | None) -> str:
    return "" if error is None else f" ± {error:.2g}"
