"""How good identification is: scene x law against the truth of the scene, one JSON line a case, resumable.

    python benchmarks/identification.py OUT --scenes SCENE … [--laws neural true auto …] [--seeds 0 1 …]
                                        [--geometry-loss trajectory …] [--no-silhouette] [--set KEY=VALUE …]
    python benchmarks/identification.py OUT --scenes SCENE --unseen OTHER_SCENE …      laws of SCENE on other throws
    python benchmarks/identification.py OUT --table                                    what is there, as Markdown

Law ``true`` is the family that made the scene. A scene is reconstructed once a seed and fitted with each law from the
same trajectories. A case whose line is in OUT/results.jsonl is not run again; one that was killed goes on where it was.
The truth is read by ``masiv evaluate`` alone, after the fit.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from identification_table import tables
from parameters import FAMILY, true_parameters

RUN = "from masiv.cli.main import run; run()"
KEPT = ("gaussians.ply", "deformation.safetensors", "trajectory.npz", "log.csv")


@dataclass(frozen=True)
class Case:
    """One fit. settings: configuration keys beside the preset's, as KEY=VALUE."""

    scene: Path
    law: str
    seed: int
    geometry_loss: str
    silhouette: bool
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        parts = [self.law, f"seed{self.seed}"]
        if self.geometry_loss != "trajectory":
            parts.append(self.geometry_loss)
        if not self.silhouette:
            parts.append("no-silhouette")
        return "-".join([*parts, *self.settings]).replace("/", "_")


def masiv(*arguments: str | Path) -> None:
    """Run a command of masiv in a process of its own: what it takes is its own, too."""
    subprocess.run([sys.executable, "-c", RUN, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def overrides(settings: tuple[str, ...], path: Path) -> list[str | Path]:
    """``--config`` with a file of ``settings``, or nothing."""
    if not settings:
        return []
    nested: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        *sections, key = name.split(".")
        inner = nested
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[key] = yaml.safe_load(value)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(nested), encoding="utf-8")
    return ["--config", path]


def base_run(case: Case, out: Path, preset: str, fit_frames: int) -> Path:
    """The run with the scene's reconstruction and trajectories."""
    upstream = tuple(s for s in case.settings if s.startswith(("reconstruct.", "trajectory.")))
    run = out / case.scene.name / "-".join(["base", f"seed{case.seed}", *upstream])
    if not (run / "trajectory.npz").is_file():
        config = overrides(upstream, out / "config.yaml")
        masiv("reconstruct", case.scene, "--out", run, "--preset", preset, "--seed", str(case.seed),
              "--fit-frames", str(fit_frames), *config)  # fmt: skip
        masiv("trajectory", run)
    return run


def fit(case: Case, base: Path, out: Path, preset: str, fit_frames: int) -> Path:
    """The run of ``case``, from the trajectories of ``base``."""
    run = out / case.scene.name / case.name
    if not run.exists():
        run.mkdir(parents=True)
        for name in KEPT:
            if (base / name).exists():
                shutil.copy(base / name, run / name)
        record = yaml.safe_load((base / "run.yaml").read_text(encoding="utf-8"))
        record["stages"]["identify"] = {"state": "pending"}
        (run / "run.yaml").write_text(yaml.safe_dump(record, sort_keys=False), encoding="utf-8")
    truth = material(case.scene)
    law = FAMILY[truth["type"]] if case.law == "true" else case.law
    extra: list[str | Path] = ["--geometry-loss", case.geometry_loss]
    extra += [] if case.silhouette else ["--no-silhouette"]
    masiv("identify", case.scene, "--out", run, "--preset", preset, "--seed", str(case.seed), "--law", law,
          "--fit-frames", str(fit_frames), *extra, *overrides(case.settings, out / "config.yaml"))  # fmt: skip
    masiv("evaluate", run, "--truth", case.scene / "gt")
    return run


def material(scene: Path) -> dict[str, Any]:
    """What made the scene: for the table, and for the name of the family that law ``true`` stands for."""
    return yaml.safe_load((scene / "truth.yaml").read_text(encoding="utf-8"))["material"]


def measured(case: Case, run: Path) -> dict[str, Any]:
    """The line of a finished case."""
    evaluation = json.loads((run / "evaluate.json").read_text(encoding="utf-8"))
    record = yaml.safe_load((run / "run.yaml").read_text(encoding="utf-8"))
    twin = yaml.safe_load((run / "twin.yaml").read_text(encoding="utf-8"))
    truth = material(case.scene)
    law = twin["law"]
    found = {}
    expected = true_parameters(truth) if law["kind"] == FAMILY[truth["type"]] else {}
    for name, entry in law.get("parameters", {}).items():
        found[name] = {**entry, "true": expected.get(name)}
    pictures = ("psnr_db", "psnr_box_db", "psnr_box_in_scene_db", "ssim", "ssim_box", "mask_iou")
    numbers = {}
    for split in ("observed", "future"):
        motion, seen = evaluation["motion"]["twin"][split], evaluation["twin"][split]
        if motion is not None:
            numbers[split] = {key: motion[key] for key in motion if key != "frames"}
            numbers[split] |= {key: seen.get(key) for key in pictures} if seen else {}
    return {
        "what": "fit", "scene": case.scene.name, "material": truth["type"], "law": case.law, "fitted": law["kind"],
        "seed": case.seed, "geometry_loss": case.geometry_loss, "silhouette": case.silhouette,
        "settings": list(case.settings), "frames": [record["split"]["fit_frames"], evaluation["truth"]["frames"]],
        "floor": evaluation["chamfer_floor_1e3mm2"], "trajectory": evaluation["motion"]["trajectory"]["observed"],
        "rigid": evaluation["motion"].get("rigid, stops at the ground", {}).get("future"),
        **numbers, "contact": twin["contact"], "parameters": found,
        "fit_error_mm": twin["fit"]["trajectory_error_mm"], "start": twin["fit"].get("start"),
        "families": [{k: v for k, v in row.items() if k != "parameters"} for row in twin["fit"].get("families", [])],
        "seconds": {name: stage["seconds"] for name, stage in record["stages"].items() if "seconds" in stage},
    }  # fmt: skip


def unseen(of: Path, other: Path, scene: Path) -> dict[str, Any]:
    """The law of run ``of`` on the throw of run ``other``, whose frames give body, velocity and spin alone, these as
    estimated from free flight: nothing after its first contact was seen. Ground and contact are those of ``of``."""
    import dataclasses

    import numpy as np

    from masiv import runtime
    from masiv.mpm.simulate import simulate
    from masiv.report.measure import motion_numbers, read_truth
    from masiv.scene.read import read_scene
    from masiv.twin import Twin

    runtime.start("cpu")
    learnt, body = Twin.load(of), Twin.load(other)
    read = read_scene(scene)
    thrown = dataclasses.replace(
        body, law=learnt.law, ground=learnt.ground, contact=learnt.contact, simulator=learnt.simulator,
        velocity=np.array(body.fit["launch_velocity_m_per_s"]), omega=np.array(body.fit["launch_omega_rad_per_s"]),
    )  # fmt: skip
    motion = simulate(thrown, frames=read.frame_count, fps=read.fps)
    truth = read_truth(scene / "gt", read.frame_count)
    return {"all frames": motion_numbers(motion.positions, truth, list(range(read.frame_count)))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, nargs="+", default=[])
    parser.add_argument("--laws", nargs="+", default=["neural"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--geometry-loss", nargs="+", default=["trajectory"])
    parser.add_argument("--no-silhouette", action="store_true")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="configuration over the preset")
    parser.add_argument("--unseen", type=Path, nargs="+", default=[], help="throws that a law of --scenes is tried on")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--fit-frames", type=int, default=12)
    parser.add_argument("--table", action="store_true", help="print the tables and do nothing else")
    o = parser.parse_args()
    results = o.out / "results.jsonl"
    rows = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()] if results.is_file() else []
    done = {row["case"] for row in rows}
    chosen = [] if o.table else itertools.product(o.scenes, o.seeds, o.laws, o.geometry_loss)
    for scene, seed, law, geometry_loss in chosen:
        case = Case(scene, law, seed, geometry_loss, not o.no_silhouette, tuple(o.set))
        runs: dict[Path, Path] = {}
        for where in (scene, *o.unseen):
            here = Case(where, law, seed, geometry_loss, not o.no_silhouette, tuple(o.set))
            key = f"{where.name}/{here.name}"
            runs[where] = o.out / where.name / here.name
            if key in done:
                continue
            began = time.monotonic()
            base = base_run(here, o.out, o.preset, o.fit_frames)
            line = {"case": key, "preset": o.preset, **measured(here, fit(here, base, o.out, o.preset, o.fit_frames))}
            keep(results, rows, line)
            done.add(key)
            print(f"{key}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        for other in o.unseen:
            key = f"{scene.name}/{case.name} on {other.name}"
            if key not in done:
                found = unseen(runs[scene], runs[other], other)
                keep(results, rows, {"case": key, "what": "unseen", "scene": scene.name, "law": law, "on": other.name,
                                     "seed": seed, "settings": list(case.settings), **found})  # fmt: skip
    print(tables(rows))


def keep(results: Path, rows: list[dict[str, Any]], line: dict[str, Any]) -> None:
    """Append ``line`` to both."""
    results.parent.mkdir(parents=True, exist_ok=True)
    with results.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    rows.append(line)


if __name__ == "__main__":
    main()
