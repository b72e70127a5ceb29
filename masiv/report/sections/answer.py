"""The first screen of the report: what it is made of, what acts on it, how large the error is, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from masiv.refinement.answer import advice, together, words
from masiv.report.page import Card
from masiv.report.quantities import millimetres, percent, quantity

if TYPE_CHECKING:
    from masiv.twin import Twin

LAWS = {
    "neo_hookean": "an elastic solid (neo-Hookean)",
    "von_mises": "a plastic solid (von Mises)",
    "newtonian": "a viscous fluid (Newtonian)",
    "non_newtonian": "a fluid with a yield stress",
    "drucker_prager": "a granular material (Drucker–Prager)",
    "springs": "springs with dampers between neighbouring particles",
}
PARAMETERS = {"youngs_modulus": "Young's modulus", "poissons_ratio": "Poisson's ratio"}
VERDICTS = {
    "effect added": "The model without it does not explain what was seen.",
    "nothing missing": "No effect is needed to explain what was seen, and most effects would have shown.",
    "cannot tell": "The recording neither shows that an effect is missing nor that none is.",
    "unexplained residual": "Something acts that no effect of the library explains.",
    "ranked only": "Effects were ranked by a first-order test and not fitted.",
}
PARTS = (
    ("test", "data that no fit or choice saw"),
    ("validation", "data that were not fitted, but chosen with"),
    ("fit", "fitted data"),
)
"""Of the observations, the strictest first."""


@dataclass(frozen=True)
class Agreement:
    """An error [mm] of the twin, on what, and if ``refine`` changed it, what it was before."""

    error_mm: float
    on: str
    before_mm: float | None = None


def answer_cards(
    twin: Twin,
    material: Mapping[str, Any] | None,
    refined: Sequence[Mapping[str, Any]],
    agreements: Sequence[Agreement],
    size_m: float | None = None,
) -> list[Card]:
    """material: material.json. refined: documents of refine, a condition each. agreements: the most telling one first.
    size_m: of the object, for comparison."""
    return [
        _made_of(twin, material),
        _what_acts(refined),
        _how_large(refined, agreements, size_m),
        _how_sure(twin, material, refined),
    ]


def _made_of(twin: Twin, material: Mapping[str, Any] | None) -> Card:
    question = "What is it made of?"
    if twin.rigid:
        bodies = "A rigid body" if len(twin.bodies) == 1 else f"{len(twin.bodies)} rigid bodies"
        return Card(question, bodies, ["Their shape does not change, so no material is identified."])
    law = twin.law.description()
    lines = [
        f"{PARAMETERS.get(name, _upper(words(name)))}: {_parameter(row)}"
        for name, row in sorted(law["parameters"].items(), key=lambda item: item[1].get("stderr") is None)
        if law["kind"] in LAWS or material is None
    ]
    answer = LAWS.get(law["kind"], words(law["kind"]))
    if material is not None:
        answer = material["behaviour"] if law["kind"] not in LAWS else answer
        if law["kind"] not in LAWS:
            lines += _quantities(material)
            nearest = min(material["families"], key=lambda f: f["misfit_percent"], default=None)
            if nearest is not None:
                kind = LAWS.get(nearest["kind"], words(nearest["kind"]))
                misfit = f"{nearest['misfit_percent']:.0f} %"
                lines.append(f"A learnt law; nearest classical one: {kind}, whose stresses differ by {misfit}.")
    return Card(question, _upper(answer), lines)


def _parameter(row: Mapping[str, Any]) -> str:
    unknown = " (this motion does not determine it)" if "stderr" in row and row["stderr"] is None else ""
    return quantity(row["value"], row["unit"], row.get("stderr")) + unknown


def _quantities(material: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, row in material["quantities"].items():
        if row["value"] is None or (row["stderr_percent"] is None and row["note"]):
            continue  # the table below says why
        error = row["stderr_percent"]
        stderr = None if error is None else abs(row["value"]) * error / 100
        lines.append(f"{_upper(name)}: {quantity(row['value'], row['unit'], stderr)}")
    return lines


def _what_acts(refined: Sequence[Mapping[str, Any]]) -> Card:
    question = "What acts on it besides gravity and ground?"
    if not refined:
        return Card(question, "Not looked for yet", ["Run masiv refine on this run folder."], open=True)
    lines, names = [], []
    for document in refined:
        where = _condition(document)
        for entry in document["accepted"]:
            name = _named(entry)
            names.append(name)
            values = ", ".join(
                f"{words(key)} {quantity(value, entry['unit'].get(key, ''), entry['stderr'].get(key))}"
                for key, value in entry["theta"].items()
            )
            lines.append(f"{where}{_upper(name)}: {values}")
            if others := entry.get("indistinguishable_from"):
                lines.append(f"This motion does not distinguish it from {', '.join(map(words, others))}.")
        if not document["accepted"]:
            lines.append(f"{where}{_upper(document['verdict'])}.{_most_probable(document)}")
    if names:
        return Card(question, _upper(", ".join(dict.fromkeys(names))), lines)
    verdicts = {document["verdict"] for document in refined}
    if verdicts == {"nothing missing"}:
        return Card(question, "Nothing that this motion shows", [_excluded(document) for document in refined])
    return Card(question, "No effect is named", lines, open=True)


def _excluded(document: Mapping[str, Any]) -> str:
    limits = document["upper_limits"]
    known = sum(1 for limit in limits if limit["determined"])
    return f"{_condition(document)}{known} of {len(limits)} effects have an upper limit that this recording determines."


def _most_probable(document: Mapping[str, Any]) -> str:
    rows = [c for c in document["candidates"] if c.get("probability") is not None]
    if not rows:
        return ""
    best = max(rows, key=lambda c: c["probability"])
    return f" Most probable effect: {words(best['effect'])}, {percent(best['probability'])}."


def _how_large(refined: Sequence[Mapping[str, Any]], agreements: Sequence[Agreement], size_m: float | None) -> Card:
    """Errors of the twin; of the fits of ``refine`` if they are of another model, named as such."""
    changed = [text for document in refined if document["accepted"] for text in _errors(document)]
    own = [_agreement(agreement) for agreement in agreements]
    tested = [text for document in refined if not document["accepted"] for text in _errors(document)[:1]]
    rows = [*changed, *own]
    lines = [f"{meaning}." for _, meaning in rows[:1]] + [f"{value}: {meaning}." for value, meaning in rows[1:4]]
    lines += [f"{value}: {meaning}, of the classical law that masiv refine fitted." for value, meaning in tested]
    lines += [f"{_condition(d)}Noise of the observation: {millimetres(d['noise_floor_mm'])}." for d in refined]
    if size_m is not None:
        lines.append(f"The object is {size_m:.2g} m wide.")
    headline = rows[0][0] if rows else "Not measured"
    return Card("How far is the twin from what was seen?", headline, [_upper(line) for line in lines], open=not rows)


def _errors(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """RMS distance without and with what was added, and on what; the strictest part first."""
    found = []
    for part, meaning in PARTS:
        before, after = (_mm(document[when], part) for when in ("before", "after"))
        if before is None or after is None:
            continue
        text = f"{millimetres(before)} → {millimetres(after)}" if document["accepted"] else millimetres(after)
        where = f", condition {document['condition']}" if document.get("condition") else ""
        found.append((text, f"RMS on {meaning}{where}"))
    return found


def _agreement(agreement: Agreement) -> tuple[str, str]:
    own = millimetres(agreement.error_mm)
    return own if agreement.before_mm is None else f"{millimetres(agreement.before_mm)} → {own}", agreement.on


def _how_sure(twin: Twin, material: Mapping[str, Any] | None, refined: Sequence[Mapping[str, Any]]) -> Card:
    question = "How sure is that?"
    if not refined:
        lines = ["Nothing was tested against this twin yet: masiv refine looks for effects that it lacks."]
        if material is not None and (unknown := _not_excited(material)):
            lines.append(f"This motion does not tell: {', '.join(unknown)}.")
        return Card(question, "Fitted, not tested", lines, open=True)
    lines = []
    for document in refined:
        where = _condition(document)
        lines.append(f"{where}{VERDICTS.get(document['verdict'], '')}")
        if len(refined) > 1:
            lines.append(
                f"Probability that no effect of the library acts: {percent(document['null_probability'])}, that "
                f"something unknown acts: {percent(document['unknown_probability'])}."
            )
        elif document["verdict"] != "ranked only":
            lines += _probabilities(document)
        told = advice(document)
        lines += [f"{where}{_upper(told)}."] if told else []
    doubtful = any(document["verdict"] not in ("effect added", "nothing missing") for document in refined)
    answer = "; ".join(dict.fromkeys(_upper(document["verdict"]) for document in refined))
    return Card(question, answer, lines, open=doubtful)


def _probabilities(document: Mapping[str, Any]) -> list[str]:
    lines = []
    first = next(iter(document["credible_set"]), None)
    if document["accepted"]:
        lines.append(f"Probability of the model without any effect: {percent(document['null_probability'])}.")
        if first is not None:
            lines.append(
                f"Most probable in the first round: {together(first['effects'])}, {percent(first['probability'])}."
            )
    else:
        lines.append(f"Probability that no effect of the library acts: {percent(document['null_probability'])}.")
        may_act = [s for s in document["credible_set"] if s["effects"]]
        told = (f"{together(s['effects'])} ({percent(s['probability'])})" for s in may_act)
        lines += [f"Not excluded: {', '.join(told)}."] if may_act else []
    lines.append(f"Probability that something unknown acts: {percent(document['unknown_probability'])}.")
    chance = document["predictive_p"]["after"]
    more = "else " if document["accepted"] else ""
    lines.append(
        f"With nothing {more}missing, a residual of at least this size has a probability of {percent(chance)}."
    )
    return lines


def _not_excited(material: Mapping[str, Any]) -> list[str]:
    return [row["name"] for row in material["sensitivities"] if not row["excited"]]


def _named(entry: Mapping[str, Any]) -> str:
    scope = entry.get("scope", "all")
    return words(entry["effect"]) + ("" if scope == "all" else f" ({scope})")


def _condition(document: Mapping[str, Any]) -> str:
    return f"Condition {document['condition']}: " if document.get("condition") else ""


def _mm(errors: Mapping[str, Any], part: str) -> float | None:
    return (errors.get(part) or {}).get("trajectory_rmse_mm")


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]
