"""Are the probabilities of refine right? Motions whose truth is known, with one effect or none, searched in full.

    python benchmarks/refine_calibration.py OUT.jsonl {flights|linear|mpm} --draws 1500 [--first 0] [--jobs 1]
    python benchmarks/refine_calibration.py --table OUT.jsonl … [--diagram FILE.svg]

One JSON line a draw; draws that are in OUT are skipped, so that a stopped run goes on. Draws: ``calibration_draws.py``;
statistics: ``calibration_table.py``. By default two draws of three have no effect and strengths are drawn from the
prior of refine: then its probabilities should come true as often as they say.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from scipy.special import ndtr

sys.path.insert(0, str(Path(__file__).parent))

NULL_FRACTION = 2 / 3
"""Prior probability of no effect, of at most one (``masiv.refinement.hypotheses.log_prior``)."""


def row_of(source: str, null_fraction: float, narrow: bool, seed: int) -> dict:
    """What refine says of a draw, and what is true."""
    from calibration_draws import draw

    from masiv.refinement.search_state import SearchSettings
    from masiv.refinement.stage import refine

    began = time.process_time()
    given = draw(source, seed, null_fraction=null_fraction, narrow=narrow)
    settings = SearchSettings.of(given.config, discrepancy_force=False)
    result = refine(given.forward_model, given.baselines, settings)
    search, named = result.search, [t.effect for t in result.accepted]
    first = search.rounds[0]
    sets = first.posterior.sets() if first.posterior else {frozenset(): 1.0}
    credible = first.posterior.credible_set() if first.posterior else sets
    row = {
        "source": source, "seed": seed, "null_fraction": null_fraction, "narrow": narrow,
        "effect": given.effect, "truth": given.truth, "verdict": result.verdict, "named": named,
        "null": search.null_probability, "unknown": search.unknown_probability,
        "predictive_p": result.predictive_p["after"],
        "sets": {" + ".join(sorted(s)) or "none": p for s, p in sets.items()},
        "credible": [" + ".join(sorted(s)) or "none" for s in credible],
        "log_bayes_factors": {t.effect: t.log_bayes_factor for t in first.trials},
        "found": {p.name: [result.after.values[p.name], result.after.stderr[p.name]]
                  for t in result.accepted for p in t.strengths},
        "limits": {x.effect: [x.strength, x.motion_mm, x.determined] for x in search.limits},
        "posterior": posterior_of_truth(given, settings, first, result.forward_model) if given.effect else None,
    }  # fmt: skip
    return {**row, "seconds": time.process_time() - began}


def posterior_of_truth(given, settings, first, forward_model) -> dict | None:
    """The strengths of the true effect in the model that has it, whether or not it was named: their steps, fitted
    values, posterior means and standard deviations, and the posterior probability of less than the truth. None if the
    model cannot be simulated."""
    from masiv.errors import MasivError
    from masiv.inference.evidence import Evidence
    from masiv.refinement.candidates import score
    from masiv.refinement.effect_fit import fit_with_effect
    from masiv.refinement.hypotheses import linearized
    from masiv.refinement.search import whitened_start

    fitted = next((t.fitted for t in first.trials if t.effect == given.effect), None)
    try:
        if fitted is None:
            state, _ = whitened_start(given.forward_model, given.baselines, settings)
            forward_model, scale = state.forward_model, state.robust_scale
            candidate = score(forward_model, state.fit, [given.effect], robust_scale=scale).candidates[0]
            fitted = fit_with_effect(forward_model, state.fit, candidate, scale)
        line, base = linearized(forward_model, fitted), linearized(forward_model, first.base)
    except (MasivError, IndexError):
        return None
    term = forward_model.term(given.effect)
    best = min((line, fitted.cost), (base, first.base.cost), key=lambda pair: pair[1])[0]
    evidence = Evidence.of(forward_model.observations, best.fields)
    index = [[p.name for p in line.parameters].index(p.name) for p in term.strengths]
    at = np.array([line.values[p.name] for p in term.strengths])
    true = np.array([given.truth[p.name] for p in term.strengths])
    pooled = evidence.marginal(line, [term])
    mean, sd = at + pooled.mean[index], np.sqrt(np.diag(pooled.covariance)[index])
    return {
        "step": [p.step for p in term.strengths], "fitted": at.tolist(), "mean": mean.tolist(), "sd": sd.tolist(),
        "below": probability_below(evidence, line, term, index, true - at).tolist(),
    }  # fmt: skip


def probability_below(evidence, line, term, index, offset) -> np.ndarray:
    """Posterior probability that strengths are less than ``offset`` (K,) beyond their fitted values, of the mixture
    over scales of the prior and over whether something unknown acts; none is below its bound."""
    from masiv.inference.error_model import ErrorModel
    from masiv.inference.marginal_likelihood import SizePriors, marginal

    blocks, priors = tuple(evidence.blocks(line)), evidence.priors(line, [term])
    sizes = SizePriors.of(blocks)
    parts, logs = [], []
    for prior, own in ((2 / 3, sizes), (1 / 3, sizes.with_unknown(blocks))):
        found = marginal(blocks, priors, own)
        gram = _gram(ErrorModel(blocks, found.logs), priors.mean)
        below, total = np.zeros(len(index)), np.zeros(len(index))
        components = [_component(gram, precision) for precision in priors.precision]
        highest = max(log for log, _, _ in components)
        for log, mean, covariance in components:
            m, s = (priors.mean + mean)[index], np.sqrt(np.diag(covariance)[index])
            zero = (priors.mean[index] - m) / s
            floor = np.where(np.isin(index, priors.positive), zero, -np.inf)
            weight = np.exp(log - highest)
            below += weight * np.maximum(ndtr((offset - m) / s) - ndtr(floor), 0)
            total += weight * (1 - ndtr(floor))
        parts.append(below / total)
        logs.append(found.log_evidence + np.log(prior))
    weights = np.exp(np.array(logs) - np.logaddexp.reduce(logs))
    return weights @ np.array(parts)


def _gram(model, offset):
    """(1 + P, 1 + P) of the residual at the prior mean and the derivatives, whitened."""
    out = 0.0
    data = [np.concatenate([(b.residual + b.jacobian @ offset)[:, :, None], b.jacobian], axis=2) for b in model.blocks]
    for b, white in zip(model.blocks, model.whiten(data), strict=True):
        rows = white.reshape(-1, white.shape[2])
        out = out + b.weight * rows.T @ rows
    return out


def _component(gram, precision):
    """Log density but for a constant, mean (P,) about the prior mean and covariance (P, P) of one component."""
    covariance = np.linalg.inv(gram[1:, 1:] + np.diag(precision))
    mean = -covariance @ gram[1:, 0]
    log = 0.5 * (-mean @ gram[1:, 0] + np.linalg.slogdet(covariance)[1] + np.log(precision).sum())
    return log, mean, covariance


def rows_in(paths) -> list[dict]:
    return [json.loads(line) for p in paths if p.exists() for line in p.read_text().splitlines()]


def _start() -> None:
    import torch

    from masiv import runtime

    runtime.start("cpu")
    torch.set_num_threads(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("source", nargs="?", choices=("flights", "linear", "mpm"))
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--null-fraction", type=float, default=NULL_FRACTION, help="part of the draws without effect")
    parser.add_argument("--narrow", action="store_true", help="strengths evenly in the logarithm, not of the prior")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--table", type=Path, nargs="+", metavar="FILE", help="print the statistics of these rows")
    parser.add_argument("--diagram", type=Path, help="with --table: where the reliability diagram goes (SVG or PNG)")
    given = parser.parse_args()
    if given.table:
        from calibration_table import diagram, table

        rows = rows_in(given.table)
        print(table(rows))
        if given.diagram:
            diagram(rows, given.diagram)
        return
    if given.out is None or given.source is None:
        parser.error("name a file for the rows and a source of draws, or give --table")
    same = {"source": given.source, "null_fraction": given.null_fraction, "narrow": given.narrow}
    done = {r["seed"] for r in rows_in([given.out]) if same.items() <= r.items()}
    todo = [seed for seed in range(given.first, given.first + given.draws) if seed not in done]
    function = functools.partial(row_of, given.source, given.null_fraction, given.narrow)
    with multiprocessing.get_context("spawn").Pool(given.jobs, _start) as pool, given.out.open("a") as file:
        for row in pool.imap_unordered(function, todo):
            file.write(json.dumps(row) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
