"""What does refine name in filmed scenes, and how near does it come to a model that knows the truth?

    python benchmarks/refine_scenes.py RUN SCENE/truth.yaml --out FILE.jsonl [--second-run RUN2]
    python benchmarks/refine_scenes.py --table FILE.jsonl

RUN: what ``masiv identify SCENE --fit-frames N`` left. One JSON line a run; the run itself is not changed.
"""

import argparse
import json
import time
from pathlib import Path

import yaml

FAMILIES = {"elastic": "neo_hookean", "plasticine": "von_mises", "newtonian": "newtonian",
            "non_newtonian": "non_newtonian", "sand": "drucker_prager"}  # fmt: skip
PARAMETERS = {"E": "youngs_modulus", "nu": "poissons_ratio", "yield_stress": "yield_stress"}


def true_effects(truth):
    """The undeclared effect of a scene as effects of the library, with values."""
    effect = truth.get("effect") or {"name": "none"}
    match effect["name"]:
        case "none":
            return {}
        case "drag":
            return {"linear_drag": {"rate": effect["linear"]}, "quadratic_drag": {"coefficient": effect["quadratic"]}}
        case "wind":
            return {"body_force": {f"acceleration_{axis}": effect["acc"][k] for k, axis in enumerate("xyz")}}
        case "kelvin_voigt":
            return {"viscosity": {"viscosity": effect["eta"]}}
    raise SystemExit(f"no effect of the library is like '{effect['name']}'")


def measured(run, truth_file, second, given):
    from oracle import oracle

    from masiv.config import RefineConfig
    from masiv.pipeline import reopen_run
    from masiv.pipeline.refine_video import recording_of
    from masiv.refinement.document import document as document_of
    from masiv.refinement.from_video import refine_recordings
    from masiv.twin.identified import load_identified

    truth = yaml.safe_load(truth_file.read_text())
    recordings, began = [], time.time()
    for path in [run, *second]:
        opened = reopen_run(path)
        if not recordings:
            opened.start()
            first = opened.config
        recordings.append(recording_of(opened, quiet, split_cameras=True))
    twin = load_identified(run)
    config = RefineConfig.model_validate({**first.refine.model_dump(), **given})
    start = twin.fit.get("start") or twin.fit.get("law")
    loaded = time.time()
    result = refine_recordings(recordings, first.identify, first.simulator, config, start=start, progress=quiet)
    done = time.time()
    document = document_of(result)
    effects = true_effects(truth)
    known_truth = None
    law = FAMILIES[truth["material"]["type"]]
    known = {PARAMETERS[k]: float(v) for k, v in truth["material"].items() if k in PARAMETERS}
    if effects:
        contact = result.after.model.contact
        known_truth = oracle(
            result.forward_model, result.search, law=law, contact=contact, parameters=known, effects=effects
        )
    keep = ("verdict", "candidates", "accepted", "before", "after", "reduced_chi", "rounds", "laws")
    return {
        "run": run.name,
        "second": [p.name for p in second],
        "true": effects,
        "document": {k: document[k] for k in keep if k in document},
        "oracle": known_truth,
        "rollouts": result.forward_model.rollouts,
        "seconds": [loaded - began, done - loaded],
    }


def quiet(*_):
    """No progress."""


def table(path):
    print("| scene | true | ranked first | accepted | before, fitted / validation [mm] | after | oracle | s |")
    print("|---|---|---|---|---|---|---|---|")
    for line in Path(path).read_text().splitlines():
        r = json.loads(line)
        d, best = r["document"], r["oracle"]
        ranked = ", ".join(f"{c['effect']} {100 * c['explained']:.0f} %" for c in d["candidates"][:2])
        values = "; ".join(
            f"{a['effect']} " + ", ".join(f"{v:.3g} ± {a['stderr'][n]:.2g}" for n, v in a["theta"].items())
            for a in d["accepted"]
        )
        pair = "{:.1f} / {:.1f}".format
        shown = " + ".join([r["run"], *r["second"]])
        oracle = "–" if not best else best.get("problem") or pair(best["fit_mm"], best["validation_mm"])
        parts = ("fit", "validation")
        before, after = ([d[k][part]["trajectory_rmse_mm"] for part in parts] for k in ("before", "after"))
        cells = (shown, ", ".join(r["true"]) or "none", ranked, values or d["verdict"], pair(*before), pair(*after),
                 oracle, f"{sum(r['seconds']):.0f}")  # fmt: skip
        print(f"| {' | '.join(cells)} |")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("truth", nargs="?", type=Path)
    parser.add_argument("--out", default="refine_scenes.jsonl")
    parser.add_argument("--second-run", action="append", default=[], type=Path)
    parser.add_argument("--refine", default="{}", help="keys of the section refine of the configuration, as JSON")
    parser.add_argument("--table")
    options = parser.parse_args()
    if options.table:
        table(options.table)
        return
    row = measured(options.run, options.truth, options.second_run, json.loads(options.refine))
    with Path(options.out).open("a") as file:
        file.write(json.dumps(row) + "\n")
    table(options.out)


if __name__ == "__main__":
    main()
