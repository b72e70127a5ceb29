"""Statistics of rows of ``refine_calibration.py``: false discoveries, coverage, upper limits, power, reliability."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import beta, norm

PRIOR_NULL = 2 / 3
"""Prior probability that no effect acts, of at most one."""
BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
"""Of stated probabilities."""
SIGNALS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, np.inf)
"""Bins of strength over its posterior standard deviation."""
ONE, TWO = 2 * norm.cdf(1) - 1, 2 * norm.cdf(2) - 1
UPPER = 0.95


def interval(count: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper & Pearson 1934)."""
    low = float(beta.ppf(0.025, count, total - count + 1)) if count else 0.0
    return low, float(beta.ppf(0.975, count + 1, total - count)) if count < total else 1.0


def share(flags: Iterable[bool]) -> str:
    """As a cell: per cent with its interval, of how many."""
    known = list(flags)
    if not known:
        return "–"
    low, high = interval(sum(known), len(known))
    return f"{100 * sum(known) / len(known):.1f} ({100 * low:.1f} to {100 * high:.1f}) of {len(known)}"


# -- what a row says --------------------------------------------------------------------------------------------------


def named_truth(row: dict) -> bool:
    return row["effect"] in row["named"]


def effect_probability(row: dict) -> float:
    """Stated probability that an effect acts, if as many draws have none as here."""
    return _odds_for(1 - row["null"], row["null_fraction"])


def named_probability(row: dict, effect: str) -> float:
    """Stated probability of ``effect``, in the same way."""
    weight = _relative(row["null_fraction"])
    stated = {name: p * (1.0 if name == "none" else weight) for name, p in row["sets"].items()}
    return stated[effect] / sum(stated.values())


def _relative(null_fraction: float) -> float:
    """Odds of an effect among the draws, over those that refine takes for granted."""
    return (1 - null_fraction) / null_fraction * PRIOR_NULL / (1 - PRIOR_NULL) if null_fraction else np.inf


def _odds_for(p: float, null_fraction: float) -> float:
    weight = _relative(null_fraction)
    return 1.0 if np.isinf(weight) else p * weight / (p * weight + 1 - p)


def component(row: dict) -> int:
    """Of a strength with several components, one a draw is looked at: draws are independent."""
    return row["seed"] % len(row["posterior"]["sd"])


def deviation(row: dict, about: str) -> float:
    """Of the ``fitted`` value or posterior ``mean`` from the truth, in posterior standard deviations."""
    k, p = component(row), row["posterior"]
    true = [row["truth"][name] for name in row["truth"]][k]
    return (p[about][k] - true) / p["sd"][k]


def below(row: dict) -> float:
    """Posterior probability of less than the truth."""
    return row["posterior"]["below"][component(row)]


def size(row: dict) -> float:
    """Of the true strength."""
    return float(np.linalg.norm(list(row["truth"].values())[: len(row["posterior"]["sd"])]))


# -- tables -----------------------------------------------------------------------------------------------------------


def table(rows: Sequence[dict]) -> str:
    """All statistics, as markdown."""
    kinds = sorted({(r["source"], r["narrow"]) for r in rows})
    parts = []
    for source, narrow in kinds:
        own = [r for r in rows if (r["source"], r["narrow"]) == (source, narrow)]
        title = f"{source}, {'narrow strengths' if narrow else 'strengths of the prior'}"
        parts.append(f"### {title}\n\n{discoveries(own)}")
        if any(r["posterior"] for r in own):
            parts += [coverage(own), power(own)]
        parts.append(reliability_table(own))
    return "\n\n".join(parts)


def discoveries(rows: Sequence[dict]) -> str:
    null, acting = [r for r in rows if r["effect"] is None], [r for r in rows if r["effect"] is not None]
    named = [r for r in rows if r["named"]]
    lines = [
        ("an effect named although none acts", (bool(r["named"]) for r in null)),
        ('"nothing missing" without an effect', (r["verdict"] == "nothing missing" for r in null)),
        ('"unexplained residual" without an effect', (r["verdict"] == "unexplained residual" for r in null)),
        ("named, not what acts, of all that are named", (not named_truth(r) for r in named)),
        ("true effect named, with an effect", (named_truth(r) for r in acting)),
        ("answer in the credible set, of all", ((r["effect"] or "none") in r["credible"] for r in rows)),
        ("true effect in the credible set, where one is named", (
            r["effect"] in r["credible"] for r in acting if r["named"])),
    ]  # fmt: skip
    seconds = np.median([r["seconds"] for r in rows])
    head = f"{len(rows)} draws, {len(null)} without an effect; {seconds:.1f} s a draw (median)."
    return f"{head}\n\n| | share [%] |\n|---|---|\n" + "\n".join(
        f"| {label} | {share(flags)} |" for label, flags in lines
    )


def coverage(rows: Sequence[dict]) -> str:
    """Of the strength in the model that has the true effect, and of upper limits."""
    acting = [r for r in rows if r["posterior"]]
    groups: list[tuple[str, list[dict]]] = [("all", acting), ("named", [r for r in acting if named_truth(r)])]
    groups += [(e, [r for r in acting if r["effect"] == e]) for e in sorted({r["effect"] for r in acting})]
    columns: list[tuple[str, Callable[[dict], bool]]] = [
        ("value ± 1 s.e.", lambda r: abs(deviation(r, "fitted")) < 1),
        ("value ± 2 s.e.", lambda r: abs(deviation(r, "fitted")) < 2),
        ("mean ± 1 s.d.", lambda r: abs(deviation(r, "mean")) < 1),
        ("mean ± 2 s.d.", lambda r: abs(deviation(r, "mean")) < 2),
        (f"central {100 * ONE:.0f} %", lambda r: abs(below(r) - 0.5) < ONE / 2),
        (f"central {100 * TWO:.0f} %", lambda r: abs(below(r) - 0.5) < TWO / 2),
    ]
    out = ["| with an effect [%] | " + " | ".join(name for name, _ in columns) + " | upper limit, where not named |"]
    out.append("|---" * (len(columns) + 2) + "|")
    for name, own in groups:
        limited = [r for r in own if r["effect"] in r["limits"]]
        cells = [share(test(r) for r in own) for _, test in columns]
        cells.append(share(size(r) <= r["limits"][r["effect"]][0] for r in limited))
        out.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def power(rows: Sequence[dict]) -> str:
    """How often the true effect is named, by its strength over the posterior standard deviation."""
    acting = [r for r in rows if r["posterior"]]
    signal = np.array([size(r) / np.linalg.norm(r["posterior"]["sd"]) for r in acting])
    pairs = list(itertools.pairwise(SIGNALS))
    out = ["| named [%], strength over its s.d. | " + " | ".join(f"{a:g} to {b:g}" for a, b in pairs) + " |"]
    out.append("|---" * (len(pairs) + 1) + "|")
    for name in ["all", *sorted({r["effect"] for r in acting})]:
        own = [name in ("all", r["effect"]) for r in acting]
        cells = [
            share(named_truth(r) for r, s, k in zip(acting, signal, own, strict=True) if k and a <= s < b)
            for a, b in pairs
        ]
        out.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(out)


# -- reliability ------------------------------------------------------------------------------------------------------


def reliability(stated: Sequence[float], happened: Sequence[bool]) -> list[tuple[float, float, float, int, int]]:
    """Of each bin of stated probabilities that has any: its ends, the mean that is stated, how many came true, how
    many there are."""
    p, true = np.asarray(stated, dtype=float), np.asarray(happened, dtype=bool)
    out = []
    for low, high in itertools.pairwise(BINS):
        own = (p >= low) & ((p < high) | (high == BINS[-1]))
        if own.any():
            out.append((low, high, float(p[own].mean()), int(true[own].sum()), int(own.sum())))
    return out


def statements(rows: Sequence[dict]) -> dict[str, tuple[list[float], list[bool]]]:
    """Stated probabilities, and whether they came true: that an effect acts; that a certain one does, of each that was
    fitted. Draws of which none or all have an effect say nothing of it."""
    rows = [r for r in rows if 0 < r["null_fraction"] < 1]
    single = [(r, e) for r in rows for e in r["sets"] if e != "none"]
    return {
        "an effect acts": ([effect_probability(r) for r in rows], [r["effect"] is not None for r in rows]),
        "this effect acts": ([named_probability(r, e) for r, e in single], [r["effect"] == e for r, e in single]),
    }


def reliability_table(rows: Sequence[dict]) -> str:
    out = ["| statement | stated | mean stated [%] | came true [%] |", "|---|---|---|---|"]
    for name, pair in statements(rows).items():
        for low, high, mean, count, total in reliability(*pair):
            flags = [True] * count + [False] * (total - count)
            out.append(f"| {name} | {100 * low:g} to {100 * high:g} % | {100 * mean:.1f} | {share(flags)} |")
    return "\n".join(out)


def diagram(rows: Sequence[dict], path: Path) -> None:
    """Reliability diagram: how often what was stated with a probability came true, with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(4.5, 4.5), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    for shift, (name, pair) in enumerate(statements(rows).items()):
        bins = reliability(*pair)
        x, y = np.array([b[2] for b in bins]) + 0.008 * shift, np.array([b[3] / b[4] for b in bins])
        ends = np.array([interval(b[3], b[4]) for b in bins]).T
        axes.errorbar(x, y, np.abs(ends - y), fmt="os"[shift], ms=4, lw=1, capsize=2, label=name)
    axes.set(xlabel="stated probability", ylabel="share that came true", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    axes.legend(loc="upper left", frameon=False)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    pyplot.close(figure)
