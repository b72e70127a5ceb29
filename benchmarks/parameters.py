"""How well the parameters of a classical law are recovered, with trajectories that a run folder already holds.

    python benchmarks/parameters.py RUN[:FAMILY] … [--out FOLDER] [--preset quick]

For each RUN the family of its scene's ``truth.yaml`` (or FAMILY, or auto) is fitted to the trajectory of RUN, which is
left as it is; a table of recovered against true parameters is printed. The truth is read only after the fit.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT_TWO_THIRDS = math.sqrt(2 / 3)
FAMILY = {
    "elastic": "neo_hookean",
    "newtonian": "newtonian",
    "plasticine": "von_mises",
    "non_newtonian": "non_newtonian",
    "sand": "drucker_prager",
}


def true_parameters(material: Mapping[str, Any]) -> dict[str, float]:
    """``material`` of a truth.yaml in the definitions of ``masiv.materials.classical``.

    The MPM published with PAC-NeRF has tau = mu sym(grad v) + kappa (J - J^-6) I: viscosity mu / 2, bulk modulus 7
    kappa; its Bingham body yields at |dev tau| = sqrt(2/3) yield stress and then adds plastic viscosity x |rate|.
    Genesis' plasticine yields at |dev tau| = yield stress.
    """
    if material["type"] == "newtonian":
        return {"viscosity": material["mu"] / 2, "bulk_modulus": 7 * material["kappa"]}
    if material["type"] == "non_newtonian":
        return {
            "shear_modulus": material["mu"],
            "bulk_modulus": material["kappa"],
            "yield_stress": ROOT_TWO_THIRDS * material["yield_stress"],
            "plastic_viscosity": material["plastic_viscosity"] / 2,
        }
    names = {"E": "youngs_modulus", "nu": "poissons_ratio", "yield_stress": "yield_stress",
             "friction_angle": "friction_angle"}  # fmt: skip
    return {ours: float(material[theirs]) for theirs, ours in names.items() if theirs in material}


def fitted(run: Path, family: str, preset: str, out: Path | None) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Description of the law, fit section and seconds."""
    from masiv import runtime
    from masiv.config import load_config
    from masiv.continuum.trajectory import Trajectory
    from masiv.identification.stage import identify
    from masiv.observations.read import read_scene
    from masiv.runfolder import RunFolder

    runtime.start("cpu")
    folder = RunFolder.open(run)
    scene = read_scene(folder.scene_path).restricted(folder.fit_frames, folder.holdout_cameras)
    config = load_config(preset, **{"identify.law": family})
    began = time.monotonic()
    twin = identify(scene, Trajectory.load(folder.trajectory), config.identify, config.simulator, seed=config.seed)
    seconds = time.monotonic() - began
    if out is not None:
        target = out / f"{run.name}-{family}"
        target.mkdir(parents=True, exist_ok=True)
        twin.save(target)
    return twin.law.description(), twin.fit, seconds


def main() -> None:
    from masiv.runfolder import RunFolder

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN[:FAMILY]")
    parser.add_argument("--out", type=Path, help="keep the twins here")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for argument in options.runs:
        name, _, family = argument.partition(":")
        run = Path(name)
        truth = yaml.safe_load((RunFolder.open(run).scene_path / "truth.yaml").read_text(encoding="utf-8"))["material"]
        family = family or FAMILY[truth["type"]]
        law, fit, seconds = fitted(run, family, options.preset, options.out)
        expected = true_parameters(truth) if law["kind"] == FAMILY[truth["type"]] else {}
        for parameter, entry in law["parameters"].items():
            rows.append({
                "run": run.name, "law": law["kind"], "parameter": parameter, "unit": entry["unit"],
                "recovered": entry["value"], "stderr": entry.get("stderr"), "true": expected.get(parameter),
                "trajectory_error_mm": fit["trajectory_error_mm"], "rollouts": fit.get("rollouts"),
                "seconds": seconds, "families": fit.get("families"),
            })  # fmt: skip
    print(json.dumps({"rows": rows}) if options.json else table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| run | law | parameter | recovered | ± | true | error [mm] | rollouts | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        true, spread = ("–" if row[key] is None else f"{row[key]:.3g}" for key in ("true", "stderr"))
        lines.append(
            f"| {row['run']} | {row['law']} | {row['parameter']} [{row['unit']}] | {row['recovered']:.4g} | {spread} "
            f"| {true} | {row['trajectory_error_mm']:.1f} | {row['rollouts']} | {row['seconds']:.0f} |"
        )
    seen: set[str] = set()
    for row in rows:
        if row["families"] and row["run"] not in seen:
            seen.add(row["run"])
            for family in row["families"]:
                failed = family.get("failed")
                said = failed or f"{family['trajectory_error_mm']:.1f} mm"
                lines.append(f"{row['run']}, {family['law']}: {said}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
