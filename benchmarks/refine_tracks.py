"""Which effect does refine name? Simulated motions with undeclared effects, as tracks with correlated noise.

    python benchmarks/refine_tracks.py --out FILE.jsonl [--only NAME] [--particles 1500] [--set KEY=VALUE …]

One JSON line a case; cases already in FILE are skipped, so that a stopped run goes on. ``--table FILE`` prints the
confusion table. ``--oracle`` fits models that know the true effects; ``--table FILE --oracles FILE2`` shows both.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).parent))

ELASTIC = ("neo_hookean", {"youngs_modulus": 3e4, "poissons_ratio": 0.3})
STIFF = ("neo_hookean", {"youngs_modulus": 8e4, "poissons_ratio": 0.3})
PLASTIC = ("von_mises", {"youngs_modulus": 1e5, "poissons_ratio": 0.3, "yield_stress": 2e3})
MATERIALS = {"elastic": ELASTIC, "stiff": STIFF, "plastic": PLASTIC}

STRENGTHS = {
    "linear_drag": [{"rate": 0.3}, {"rate": 0.8}],
    "quadratic_drag": [{"coefficient": 0.15}, {"coefficient": 0.4}],
    "body_force": [
        {"acceleration_x": 0.6, "acceleration_y": 0.0, "acceleration_z": -0.4},
        {"acceleration_x": -1.5, "acceleration_y": 0.0, "acceleration_z": 1.0},
    ],
    "gravity_scale": [{"relative_change": -0.1}, {"relative_change": 0.15}],
    "ground_friction": [{"slipperiness": 5.0}, {"slipperiness": 20.0}],
    "restitution": [{"coefficient": 0.4}, {"coefficient": 0.8}],
    "ground_height": [{"height": 0.08}],
    "viscosity": [{"viscosity": 30.0}, {"viscosity": 80.0}],
    "stiffness_contrast": [{"log_stiffness_ratio": 1.5, "x": 0.05, "y": 0.55, "z": 0.0, "radius": 0.15}],
    "hidden_obstacle": [{"radius": 0.12, "x": 0.45, "y": 0.12, "z": 0.1}],
    "point_mass": [{"mass": 3.0, "x": 0.0, "y": 0.5, "z": -0.1}],
    "periodic_force": [
        {"cosine_x": 2.0, "cosine_y": 0.0, "cosine_z": 0.0, "sine_x": 0.0, "sine_y": 0.0, "sine_z": 2.0,
         "frequency": 4.0}
    ],
    "swirl": [{"strength": 6.0, "x": 0.0, "z": 0.0}],
    "time_offset": [{"delay": 0.02}, {"delay": -0.015}],
}  # fmt: skip

PAIRS = (
    ("quadratic_drag", "restitution"), ("body_force", "viscosity"), ("linear_drag", "swirl"),
    ("quadratic_drag", "point_mass"), ("ground_friction", "quadratic_drag"), ("body_force", "ground_friction"),
    ("linear_drag", "periodic_force"), ("body_force", "stiffness_contrast"), ("ground_friction", "viscosity"),
    ("body_force", "restitution"),
)  # fmt: skip
"""Strong effects that act at once on the elastic body, in addition to two pairs of other strengths."""
OTHER = {"viscosity": "stiff", "restitution": "stiff"}
"""The second material of an effect, if that is not the plastic one: what damps or bounces hardly shows there."""
OUTSIDE = {
    "attraction": {"strength": 0.5, "x": 0.6, "y": 0.7, "z": 0.5},
    "gust": {"acceleration": 20.0, "begin": 0.1, "end": 0.2},
    "swelling": {"pressure": 4000.0},
}


def cases():
    """Controls of every material; every effect, strong on an elastic body and weak on another; two at once; unknown;
    the other way round, weak on an elastic body and strong on another; a pull that is nothing like uniform; more pairs.
    """
    from track_cases import Case

    out = []
    for material, (law, parameters) in MATERIALS.items():
        out.append(Case(f"control_{material}", law, parameters, {}, seed=len(out)))
    for effect, strengths in STRENGTHS.items():
        other = OTHER.get(effect, "plastic")
        for values, material in ((strengths[-1], "elastic"), (strengths[0], other)):
            law, parameters = MATERIALS[material]
            out.append(Case(f"{effect}_{material}", law, parameters, {effect: values}, seed=len(out)))
    law, parameters = ELASTIC
    two = {"linear_drag": {"rate": 0.6}, "body_force": STRENGTHS["body_force"][1]}
    out.append(Case("linear_drag+body_force", law, parameters, two, seed=len(out)))
    two = {"linear_drag": {"rate": 0.6}, "viscosity": {"viscosity": 60.0}}
    out.append(Case("linear_drag+viscosity", law, parameters, two, seed=len(out)))
    for name, values in OUTSIDE.items():
        out.append(Case(f"unknown_{name}", law, parameters, {}, seed=len(out), outside={name: values}))
    for effect, strengths in STRENGTHS.items():
        if len(strengths) > 1:
            other = OTHER.get(effect, "plastic")
            for values, material, word in ((strengths[0], "elastic", "weak"), (strengths[-1], other, "strong")):
                law, parameters = MATERIALS[material]
                name = f"{effect}_{material}_{word}"
                out.append(Case(name, law, parameters, {effect: values}, seed=len(out)))
    law, parameters = ELASTIC
    near = {"attraction": {"strength": 0.5, "x": 0.45, "y": 0.5, "z": 0.35}}
    out.append(Case("unknown_attraction_near", law, parameters, {}, seed=len(out), outside=near))
    for names in PAIRS:
        two = {name: STRENGTHS[name][-1] for name in names}
        out.append(Case("+".join(names), law, parameters, two, seed=len(out)))
    return sorted(out, key=lambda case: case.law != "neo_hookean" or case.name.endswith("_stiff"))


def baseline_fits(case, config):
    """Simulation, experiment, and fits of laws without effects."""
    from track_cases import observed

    return fits_of(*observed(case), case.fit_frames, config)


def fits_of(scene, motion, fit_frames, config):
    """The same of the ``motion`` of a ``scene``, of which ``fit_frames`` are fitted."""
    import torch

    from masiv.checkpoint import Checkpoint
    from masiv.identification.config import IdentifyConfig
    from masiv.models.free_body import FreeBodyModel
    from masiv.mpm.config import SimulatorConfig
    from masiv.observations.motion import SampledMotion
    from masiv.refinement.baselines import BaselineProblem, baselines
    from masiv.refinement.prepare import prepare
    from masiv.workers import Workers

    torch.set_num_threads(1)
    cut = SampledMotion(motion.positions[:fit_frames], motion.times[:fit_frames], motion.volume)
    setup, coarse, coarser, initial_motion = prepare(
        "0", scene, cut, motion, IdentifyConfig.model_validate({}), SimulatorConfig.model_validate({}), config
    )
    simulation = FreeBodyModel([setup])
    problem = BaselineProblem(coarse, coarser, min(initial_motion.last_frame + 2, coarse.problem.frames))
    fits = baselines(simulation, problem, config, Checkpoint(None), quiet, Workers())
    return simulation, setup.observation, fits


def oracle_of(case, config):
    """Error of a model that knows the true effects, whitened as refine whitens its result: as that model moves."""
    from oracle import fit_true_model

    from masiv.inference.discretization import with_residual_std
    from masiv.models.free_body import FreeBodyModel

    began = time.time()
    simulation, _, fits = baseline_fits(case, config)
    observation_std = [e.residual_std for e in simulation.observations]
    best = min(fits, key=lambda f: f.cost)
    simulation = with_residual_std(simulation, best, observation_std)
    own = FreeBodyModel(simulation.setups)  # with substeps that the true stiffness asks for
    own = own.with_observations(simulation.observations)
    best = fit_true_model(own, [best], case.law, case.contact, case.parameters, case.effects)
    own = with_residual_std(own, best, observation_std)
    best = fit_true_model(own, [best], case.law, case.contact, case.parameters, case.effects)
    return {"case": case.name, "oracle": [best.fit_mm, best.validation_mm], "seconds": [time.time() - began]}


def refined(case, config):
    from masiv.refinement.rounds import alternatives
    from masiv.refinement.search_state import SearchSettings
    from masiv.refinement.stage import refine

    began = time.time()
    simulation, observation, fits = baseline_fits(case, config)
    middle = time.time()
    refined = refine(simulation, fits, SearchSettings.of(config))
    end = time.time()
    result, force = refined.search, refined.search.discrepancy
    first = result.rounds[0] if result.rounds else None
    accepted = result.after.model.effects
    return {
        "case": case.name,
        "true": {**case.effects, **case.outside},
        "verdict": refined.verdict,
        "discrepancy_force": None if force is None else [force.fit_mm, force.validation_mm],
        "laws": [f.model.family.kind for f in fits],
        "noise_mm": 1e3 * observation.noise_std,
        "reduced_chi": [refined.reduced_chi(fit) for fit in (result.before, result.after)],
        "residual_std_mm": (1e3 * refined.observations[0].residual_std).round(1).tolist(),
        "ranked": [(c.effect, round(c.explained, 3)) for c in first.candidates[:6]] if first else [],
        "trials": [
            (t.law, t.effect, round(t.fitted.fit_mm, 2), t.fitted.validation_mm, t.log_bayes_factor, t.impossible)
            for r in result.rounds for t in r.trials
        ],
        "accepted": list(accepted),
        "indistinguishable_from": {
            name: list(alternatives(name, result.after, result.rounds)) for name in accepted
        },
        "law": result.after.model.family.kind,
        "values": result.after.values,
        "stderr": result.after.stderr,
        "null_probability": result.null_probability,
        "before": [result.before.fit_mm, result.before.validation_mm],
        "after": [result.after.fit_mm, result.after.validation_mm],
        "seconds": [middle - began, end - middle],
    }  # fmt: skip


def quiet(*_):
    """No progress."""


ANSWERS = "named", "named, not distinguished", "among those not distinguished", "abstained", "wrong"


def lines(path):
    return [json.loads(line) for line in Path(path).read_text().splitlines()]


def table(path, oracles):
    rows, errors = lines(path), {r["case"]: r["oracle"] for r in lines(oracles)} if oracles else {}
    counts = dict.fromkeys(ANSWERS, 0)
    print(
        "| case | accepted | indistinguishable from | ranked first | before: fit / held out [mm] | after | oracle | s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for r in rows:
        counts[judged(r)] += 1
        others = ", ".join(other for names in r["indistinguishable_from"].values() for other in names)
        show = [" / ".join(f"{v:.1f}" for v in pair) if pair else "–"
                for pair in (r["before"], r["after"], errors.get(r["case"]))]  # fmt: skip
        ranked = f"{r['ranked'][0][0]} {r['ranked'][0][1]}" if r["ranked"] else "–"
        print(f"| {r['case']} | {', '.join(r['accepted']) or 'none'} | {others} | {ranked} | {show[0]} | {show[1]} | "
              f"{show[2]} | {sum(r['seconds']):.0f} |")  # fmt: skip
    print("\n" + ", ".join(f"{name}: {count}" for name, count in counts.items()) + f"; of {len(rows)}")


def judged(row):
    """What the answer is worth: a control that is left alone is named, too, and so is an effect of no library that is
    called unexplained."""
    true, found = set(row["true"]), set(row["accepted"])
    others = {other for names in row["indistinguishable_from"].values() for other in names}
    if found == true or (row["verdict"] == "unexplained residual" and not true <= STRENGTHS.keys()):
        return "named, not distinguished" if others else "named"
    if not found:
        return "abstained"
    return "among those not distinguished" if true <= found | others else "wrong"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", default="refine_tracks.jsonl")
    parser.add_argument("--only", default="")
    parser.add_argument("--particles", type=int, default=1500)
    parser.add_argument("--laws", default="", help="families that compete, with commas; the case's own if empty")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of refine")
    parser.add_argument("--per-cell", type=float, default=6.0, help="particles a cell of the truth's grid")
    parser.add_argument("--draw", type=int, default=0, help="another draw of the noise")
    parser.add_argument("--oracle", action="store_true", help="fit models that know the true effects instead")
    parser.add_argument("--table")
    parser.add_argument("--oracles", help="with --table: the file that --oracle wrote")
    options = parser.parse_args()
    if options.table:
        table(options.table, options.oracles)
        return
    from masiv import runtime
    from masiv.refinement.config import RefineConfig

    runtime.start("cpu")
    out = Path(options.out)
    done = {row["case"] for row in lines(out)} if out.exists() else set()
    for case in cases():
        if case.name in done or (options.only and options.only not in case.name):
            continue
        if options.oracle and case.outside:
            continue  # no model of the library has it
        laws = [n for n in options.laws.split(",") if n] or [case.law]
        settings = {"particles": options.particles, "laws": laws}
        settings |= {key: yaml.safe_load(value) for key, value in (s.split("=", 1) for s in options.set)}
        case = dataclasses.replace(case, per_cell=options.per_cell, seed=case.seed + 1000 * options.draw)
        row = (oracle_of if options.oracle else refined)(case, RefineConfig.model_validate(settings))
        with out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        answer = row["oracle"] if options.oracle else row["accepted"]
        print(case.name, "->", answer, [round(x) for x in row["seconds"]], flush=True)


if __name__ == "__main__":
    main()
