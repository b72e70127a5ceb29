"""How good identification is: scene x law against the truth of the scene, one JSON line a case, resumable.

    python benchmarks/identification.py OUT --scenes SCENE … [--laws neural true auto …] [--seeds 0 1 …]
                                        [--geometry-loss trajectory …] [--no-silhouette] [--set KEY=VALUE …]
    python benchmarks/identification.py OUT --scenes SCENE --unseen OTHER_SCENE …      laws of SCENE on other recordings
                                        [--also SCENE …]                               fitted to these as well
    python benchmarks/identification.py OUT --table                                    what is there, as Markdown

Law ``true`` is the family that made the scene, fitted. Law ``reference`` is not fitted: that family with its true
parameters and the true initial state, in the reconstructed body; fits in this simulator could reach that. A scene is
reconstructed once for each seed, and all laws are fitted to the same trajectories. A case whose line is in
OUT/results.jsonl is not run again, and an interrupted one is resumed. The truth is read after the fit.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from identification_table import tables
from parameters import FAMILY, true_parameters

from masiv.continuum.trajectory import Trajectory
from masiv.identification.stage import identify
from masiv.materials.classical import ClassicalLaw
from masiv.metrics import chamfer_floor
from masiv.models.initial_state import estimate_initial_motion
from masiv.mpm.config import SimulatorConfig
from masiv.mpm.design import grid_spacing
from masiv.observations.read import read_scene
from masiv.pipeline import Overrides, SceneRequest, open_run, stages
from masiv.pipeline.video import VideoRun
from masiv.report.measure import motion_numbers, read_truth
from masiv.report.numbers import both_numbers
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene
from masiv.simulation.simulate import simulate
from masiv.twin import Twin

KEPT = ("gaussians.ply", "deformation.safetensors", "trajectory.npz")
PICTURES = ("psnr_db", "psnr_box_db", "psnr_box_in_scene_db", "ssim", "ssim_box", "mask_iou")


@dataclass(frozen=True)
class Case:
    """One fit. settings: configuration keys over the preset, as KEY=VALUE. also: scenes of more recordings."""

    scene: Path
    law: str
    seed: int
    geometry_loss: str
    silhouette: bool
    settings: tuple[str, ...]
    also: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        parts = [self.law, f"seed{self.seed}"]
        if self.geometry_loss != "trajectory":
            parts.append(self.geometry_loss)
        if not self.silhouette:
            parts.append("no-silhouette")
        parts += [f"also-{scene.name}" for scene in self.also]
        return "-".join([*parts, *self.settings]).replace("/", "_")


def overrides(settings: tuple[str, ...], path: Path) -> Path | None:
    """A configuration file of ``settings``, or None if there are none."""
    if not settings:
        return None
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
    return path


def base_run(case: Case, out: Path, preset: str, fit_frames: int) -> Path:
    """The run with the scene's reconstruction and trajectories, made now if they are missing."""
    upstream = tuple(s for s in case.settings if s.startswith(("reconstruct.", "trajectory.")))
    folder = out / case.scene.name / "-".join(["base", f"seed{case.seed}", *upstream])
    if (folder / "run.yaml").is_file() and RunFolder.open(folder).done("trajectory"):
        return folder
    config = overrides(upstream, out / "config.yaml")
    run = open_run(case.scene, folder, Overrides(preset, config, case.seed), SceneRequest(fit_frames))
    run.trajectory(said)
    return folder


def fit(case: Case, base: Path, out: Path, preset: str, fit_frames: int) -> dict[str, Any]:
    """Fit ``case`` to the trajectories of ``base``; what is measured of it."""
    folder = out / case.scene.name / case.name
    if not (folder / "run.yaml").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        for name in KEPT:
            shutil.copy(base / name, folder / name)
        record = yaml.safe_load((base / "run.yaml").read_text(encoding="utf-8"))
        record["stages"]["identify"] = {"state": "pending"}
        (folder / "run.yaml").write_text(yaml.safe_dump(record, sort_keys=False), encoding="utf-8")
    family = FAMILY[truth_of(case.scene)["material"]["type"]]
    also = [base_run(dataclasses.replace(case, scene=scene), out, preset, fit_frames) for scene in case.also]
    asked = {
        "law": family if case.law in ("true", "reference") else case.law,
        "geometry_loss": case.geometry_loss,
        "pictures": None if case.silhouette else 0,
        "also": [str(path.resolve()) for path in also] or None,
    }
    settings_of_case = Overrides(preset, overrides(case.settings, out / "config.yaml"), case.seed)
    opened = open_run(case.scene, folder, settings_of_case, SceneRequest(fit_frames, identify=asked))
    assert isinstance(opened, VideoRun)
    opened.start()
    run, settings, scene = opened.folder, opened.config, opened.scene
    trajectory = stages.load_trajectory(run)
    if case.law == "reference":
        reference_twin(case.scene, scene, trajectory, settings.simulator).save(run.path)
    elif not run.done("identify"):
        with run.stage("identify") as checkpoint:
            identify(
                stages.training_scene(run, scene), trajectory, settings.identify, settings.simulator,
                others=stages.other_recordings(settings), seed=settings.seed, checkpoint=checkpoint, progress=said,
            ).save(run.path)  # fmt: skip
    twin = Twin.load(run.path)
    rollout = simulate(twin, frames=scene.frame_count, fps=scene.fps).positions
    return measured(case, run, scene, twin, trajectory.positions, rollout)


def truth_of(scene: Path) -> dict[str, Any]:
    """What made the scene: for the table, for law ``reference``, and for the family of law ``true``."""
    return yaml.safe_load((scene / "truth.yaml").read_text(encoding="utf-8"))


def reference_twin(folder: Path, scene: Scene, trajectory: Trajectory, simulator: SimulatorConfig) -> Twin:
    """The reconstructed body with the initial state, ground and law of truth.yaml."""
    truth = truth_of(folder)
    return Twin.of_body(
        positions=trajectory.positions[0], velocity=np.array(truth["initial_velocity"], float),
        omega=np.array(truth["initial_omega"], float), gravity=scene.gravity, ground=scene.ground,
        contact=truth["floor"]["mode"], friction=0.0, volume=trajectory.volume, density=scene.density, up=scene.up,
        fps=scene.fps, law=ClassicalLaw(FAMILY[truth["material"]["type"]], **true_parameters(truth["material"])),
        simulator=simulator, fit={"trajectory_error_mm": None},
    )  # fmt: skip


def measured(
    case: Case, run: RunFolder, scene: Scene, twin: Twin, trajectory: np.ndarray, rollout: np.ndarray
) -> dict[str, Any]:
    """The line of a finished case. The truth is read here, after every fit."""
    truth, points = truth_of(case.scene)["material"], read_truth(case.scene / "gt", scene.frame_count)
    law = twin.law.description()
    expected = true_parameters(truth) if law["kind"] == FAMILY[truth["type"]] else {}
    splits = {"observed": range(run.fit_frames), "future": range(run.fit_frames, scene.frame_count)}
    seen = both_numbers(run, scene, stages.load_gaussians(run), rollout)["twin"]
    numbers = {}
    for split, frames in splits.items():
        pictures = seen[split] or {}
        numbers[split] = {**motion_numbers(rollout, points, frames), **{key: pictures.get(key) for key in PICTURES}}
    return {
        "what": "fit", "scene": case.scene.name, "material": truth["type"], "law": case.law, "fitted": law["kind"],
        "seed": case.seed, "geometry_loss": case.geometry_loss, "silhouette": case.silhouette,
        "settings": list(case.settings), "also": [scene.name for scene in case.also],
        "frames": [run.fit_frames, len(points)],
        "floor": floor(points), **numbers,
        "trajectory": motion_numbers(trajectory, points, splits["observed"]), "contact": twin.contact,
        "parameters": {n: {**entry, "true": expected.get(n)} for n, entry in law["parameters"].items()},
        "fit_error_mm": twin.fit["trajectory_error_mm"], "start": twin.fit.get("start"),
        "families": [{k: v for k, v in row.items() if k != "parameters"} for row in twin.fit.get("families", [])],
        "seconds": run.seconds(),
    }  # fmt: skip


def said(stage: str, done: int, total: int, note: str = "") -> None:
    """Progress, for a log."""
    if done % max(1, total // 8) == 0:
        print(f"  {stage} {done}/{total} {note}", file=sys.stderr, flush=True)


def unseen_recording(twin: Twin, other: Path, scene: Path) -> dict[str, Any]:
    """The law of ``twin`` on another recording, of which run ``other`` gives the body and, from free flight alone,
    velocity and spin: no frame after the first contact is looked at. Ground and contact are those of ``twin``."""
    run, read = RunFolder.open(other), read_scene(scene)
    trajectory = stages.load_trajectory(run)
    spacing = grid_spacing(trajectory.volume, trajectory.positions.shape[1], twin.simulator)
    initial_motion = estimate_initial_motion(
        trajectory.positions, trajectory.times, read.gravity, read.ground, clearance=spacing
    )
    again = twin.with_body(particles=trajectory.positions[0], volume=trajectory.volume)
    again = again.with_motion(velocity=initial_motion.velocity, omega=initial_motion.omega)
    motion = simulate(again, frames=read.frame_count, fps=read.fps).positions
    truth = read_truth(scene / "gt", read.frame_count)
    after = range(initial_motion.last_frame + 1, read.frame_count)
    return {"after contact": motion_numbers(motion, truth, after), "floor": floor(truth)}


def floor(truth: np.ndarray) -> float:
    """Chamfer of two samplings of the truth (T, P, 3), mean over frames [10^3 mm^2]."""
    return float(np.mean([chamfer_floor(points) for points in truth]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, nargs="+", default=[])
    parser.add_argument("--laws", nargs="+", default=["neural"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--geometry-loss", nargs="+", default=["trajectory"])
    parser.add_argument("--no-silhouette", action="store_true")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="configuration over the preset")
    parser.add_argument("--unseen", type=Path, nargs="+", default=[], help="recordings to test a law of --scenes on")
    parser.add_argument("--also", type=Path, nargs="+", default=[], help="more recordings that the law is fitted to")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--fit-frames", type=int, default=12)
    parser.add_argument("--table", action="store_true", help="print the tables and do nothing else")
    o = parser.parse_args()
    results = o.out / "results.jsonl"
    rows = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()] if results.is_file() else []
    done = {row["case"] for row in rows}
    chosen = [] if o.table else itertools.product(o.scenes, o.seeds, o.laws, o.geometry_loss)
    for scene, seed, law, geometry_loss in chosen:
        case = Case(scene, law, seed, geometry_loss, not o.no_silhouette, tuple(o.set), tuple(o.also))
        key = f"{scene.name}/{case.name}"
        if key not in done:
            began = time.monotonic()
            base = base_run(case, o.out, o.preset, o.fit_frames)
            keep(results, rows, {"case": key, "preset": o.preset, **fit(case, base, o.out, o.preset, o.fit_frames)})
            print(f"{key}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        for other in o.unseen:
            key = f"{scene.name}/{case.name} on {other.name}"
            if key not in done:
                base = base_run(dataclasses.replace(case, scene=other), o.out, o.preset, o.fit_frames)
                fitted = Twin.load(o.out / scene.name / case.name)
                found = unseen_recording(fitted, base, other)
                keep(results, rows, {
                    "case": key, "what": "unseen", "scene": scene.name, "law": law, "fitted": fitted.law.kind,
                    "on": other.name, "seed": seed, "settings": list(case.settings),
                    "also": [s.name for s in case.also], **found,
                })  # fmt: skip
    print(tables(rows))


def keep(results: Path, rows: list[dict[str, Any]], line: dict[str, Any]) -> None:
    """Append ``line`` to both."""
    results.parent.mkdir(parents=True, exist_ok=True)
    with results.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    rows.append(line)


if __name__ == "__main__":
    main()
