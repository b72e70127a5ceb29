"""A run of a scene of tracks: measured points in place of pictures, so that there is nothing to reconstruct."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from masiv.config import Config, given_settings
from masiv.errors import InputError
from masiv.files import write_json, write_npz
from masiv.observations.identity import identity
from masiv.pipeline.requests import (
    Overrides,
    RefineRequest,
    SceneRequest,
    SimulateRequest,
    Summary,
    ViewRequest,
    problem_lines,
    refuse,
)
from masiv.pipeline.run import Run, settings
from masiv.progress import Progress, silent
from masiv.runfolder import Request, RunFolder, require_folder
from masiv.strict import read_json
from masiv.tracks.read import read_tracks
from masiv.tracks.tracks import Tracks

if TYPE_CHECKING:
    import numpy as np

    from masiv.twin import Twin
    from masiv.view.subject import Subject

NOT_FOR_TRACKS = (
    *("omega", "law", "blend", "geometry", "density", "ground"),
    *("force", "force_from", "force_until", "render", "camera", "size", "slow"),
)
"""Fields of ``SimulateRequest`` that apply to a filmed body alone."""
NOT_REQUESTED_OF_TRACKS = (
    *("fit_frames", "holdout_camera", "geometry_loss", "no_silhouette", "also"),
    "keep_calibration",
)
"""Fields of ``SceneRequest`` that apply to pictures alone."""


class TracksRun(Run):
    """See ``masiv.pipeline.run.Run``."""

    layouts = "tracks"

    def __init__(self, folder: RunFolder, config: Config, scene: Path, read: Tracks | None = None) -> None:
        super().__init__(folder, config, scene)
        self._read = read

    @property
    def tracks(self) -> Tracks:
        """Raises InputError if the scene is not there or not the run's."""
        if self._read is None:
            read = read_tracks(self.existing_scene())
            self.folder.check_scene(identity(read), self.scene_path)
            self._read = read
        return self._read

    def request(self) -> Request:
        return Request(self.config.model_dump(mode="json"), self.scene_path, identity(self.tracks), 0)

    @classmethod
    def open(cls, scene: Path, out: Path, overrides: Overrides, request: SceneRequest) -> TracksRun:
        """As ``Run.open``. The law is ``auto`` if none is named, since markers cannot teach a neural one."""
        refuse(request, NOT_REQUESTED_OF_TRACKS, "pictures", scene)
        existing = RunFolder.begun_in(out)
        given = given_settings(overrides.config, overrides.assignments).get("identify")
        named = isinstance(given, dict) and "law" in given
        law = request.identify.get("law")
        if law is None and existing is None and not named:
            law = "auto"
        config = settings(overrides, existing.config if existing else None, **{"identify.law": law})
        if config.identify.law in ("neural", "adapter"):
            raise InputError(
                f"--law {config.identify.law} needs the motion of a whole body, and markers show a few points of it: "
                "use --law auto or a classical law"
            )
        if config.identify.contact not in ("auto", "sticky"):
            raise InputError(
                f"identify.contact: {config.identify.contact} is for scenes of pictures: the ground of tracks is sticky"
            )
        tracks = read_tracks(scene)
        asked = Request(config.model_dump(mode="json"), scene, identity(tracks), 0)
        return cls(RunFolder.create_or_resume(out, asked), config, scene, tracks)

    def identify(self, progress: Progress = silent) -> Summary:
        self.start()
        with self.changing():
            return self._identify(progress)

    def _identify(self, progress: Progress) -> Summary:
        from masiv.identifiability.held_tracks import held_problems
        from masiv.identification.from_tracks import identify_tracks
        from masiv.report.numbers import given_or_error

        families: list[dict[str, Any]] = []
        if self.folder.done("identify"):
            twin = self.load_twin()
        else:
            with self.folder.stage("identify", self._say_memory("identify", progress)):
                twin, fits = identify_tracks(
                    self.tracks, self.config.identify.law, self.config.tracks, self.config.simulator,
                    folder=self._rollout_cache, progress=progress,
                )  # fmt: skip
                families = [
                    {"law": f.model.family.kind, "fit_rmse_mm": f.fit_mm, "validation_rmse_mm": f.validation_mm}
                    for f in fits
                ]
                twin.save(self.path)
        rows = self._report(twin, progress)
        law = law_entry(twin)
        problems = held_problems(self.tracks)
        data = {
            "run": str(self.path), "report": str(self.folder.report), "law": law, "families": families, "runs": rows,
            "problems": problems,
        }  # fmt: skip
        lines = [f"law      {law['kind']}"]
        for name, row in law["parameters"].items():
            error = given_or_error(row["stderr"])
            lines.append(f"         {name.replace('_', ' ')} {row['value']:.4g} {row['unit']}" + error)
        lines += [*_table(rows), *problem_lines(problems), f"report   {self.folder.report}"]
        return Summary(data, "\n".join(lines))

    def refine(self, request: RefineRequest, progress: Progress = silent) -> Summary:
        refuse(request, ("second_run", "relearn"), "pictures", self.scene_path)
        self.folder.require("identify")
        self.start()
        with self.changing():
            return self._refine(request, progress)

    def _refine(self, request: RefineRequest, progress: Progress) -> Summary:
        from masiv.identifiability.held_tracks import held_problems
        from masiv.refinement.document import document
        from masiv.refinement.document_text import text
        from masiv.refinement.from_tracks import refine_tracks
        from masiv.refinement.residual_arrays import save_arrays
        from masiv.refinement.to_twin import refined_twin
        from masiv.twin.identified import load_to_refine, save_refined

        self._say_memory("refine", progress)
        first = self._conditions[0]
        twin = load_to_refine(self.path, request.condition, self._described_twin)
        if request.group and not twin.rigid:
            raise InputError(f"{self.path} is of one body: --group is for bodies that fly free and share physics")
        result = refine_tracks(
            self.tracks, twin, self.config.refine, self.config.tracks, self.config.simulator,
            condition=request.condition, dry_run=request.dry_run, folder=self._rollout_cache, progress=progress,
        )  # fmt: skip
        runs = tuple(r for r in self.tracks.runs if request.condition in (None, r.condition))
        written = {**document(result), "problems": held_problems(self.tracks, runs)}
        stem = refine_stem(request.condition, first)
        if request.dry_run:
            write_json(self.path / f"{stem}.dry_run.json", written)
        else:
            write_json(self.path / f"{stem}.json", written)
            save_arrays(self.path / f"{stem}.npz", result)
            if result.changes_twin:
                twin = refined_twin(twin, result)
                save_refined(self.path, twin, self._described_twin)
            else:
                twin.save(self.path)
            self._report(twin, progress)
        if self._rollout_cache.is_dir():
            shutil.rmtree(self._rollout_cache)
        return Summary({"refine": str(self.path / f"{stem}.json"), **written}, text(written))

    def simulate(self, request: SimulateRequest, out: Path, progress: Progress = silent) -> Summary:
        refuse(request, NOT_FOR_TRACKS, "pictures", self.scene_path)
        self.folder.require("identify")
        require_folder(out, "--out")
        self.start()
        from masiv.simulation.simulate import simulate

        twin = self.load_twin()
        rollout = simulate(
            twin, frames=request.frames, velocity=request.velocity, gravity=request.gravity, without=request.without,
            condition=request.condition, progress=progress,
        )  # fmt: skip
        path = out / "rollout.npz"
        rollout.save(path)
        data = {
            "rollout": str(path),
            "frames": request.frames,
            "particles": rollout.positions.shape[1],
            "markers": list(rollout.marker_names),
            "effects": [e.name for e in twin.effects if e.name not in request.without],
        }
        return Summary(data, str(path))

    def subject(self, request: ViewRequest) -> Subject:
        from masiv.pipeline.view import tracks_subject

        return tracks_subject(self, request)

    def evaluate(self, truth: Path | None, progress: Progress = silent) -> Summary:
        """Errors of every run, fitted and held out apart, before and after refine: evaluate.json."""
        if truth is not None:
            raise InputError(f"--truth is for scenes of pictures: leave it out for {self.scene_path}")
        self.folder.require("identify")
        self.start()
        with self.changing():
            rows = self._report(self.load_twin(), progress)
            numbers = {
                "fit": [r for r in rows if r["use"] == "fit"],
                "held_out": [r for r in rows if r["use"] == "hold_out"],
                "test": [r for r in rows if r["use"] == "test"],
                "unit": "mm",
            }
            write_json(self.folder.evaluation, numbers)
        data = {"evaluation": str(self.folder.evaluation), **numbers}
        return Summary(data, "\n".join([*_table(rows), str(self.folder.evaluation)]))

    def _say_memory(self, stage: str, progress: Progress) -> float:
        """Say how much memory the stage is expected to take [MB]. Raises InputError if that is too much."""
        from masiv.identification.from_tracks import flight_group
        from masiv.pipeline.expected_memory import expected_tracks_memory

        expected = expected_tracks_memory(stage, self.config, flights=flight_group(self.tracks) is not None)
        return expected.announce(self.config.memory_limit_mb, progress)

    @property
    def _rollout_cache(self) -> Path:
        """Rollouts of a stage that is not finished."""
        return self.path / "checkpoints" / "rollouts"

    @property
    def _conditions(self) -> list[str]:
        return list(dict.fromkeys(run.condition for run in self.tracks.runs))

    def load_twin(self) -> Twin:
        """The run's twin; of a file of schema 1, with the bodies of the scene. Raises InputError."""
        from masiv.twin import Twin

        return Twin.load(self.path, scene=self._described_twin)

    def _described_twin(self) -> Twin:
        from masiv.identification.from_tracks import described_twin

        return described_twin(self.tracks, self.config.tracks, self.config.simulator)

    def _report(self, twin: Twin, progress: Progress) -> list[dict[str, Any]]:
        """Simulate every run with the twin, and with the one before refine if there is one; metrics.json, rollout.npz,
        report.html. Returns the errors of each run."""
        from masiv.identification.twin_over_runs import run_errors, simulate_runs
        from masiv.refinement.document_text import with_scopes
        from masiv.report.tracks import write_report
        from masiv.twin.identified import IDENTIFIED_FILE, load_identified

        twins = {"before": twin}
        if (self.path / IDENTIFIED_FILE).is_file():
            twins = {"before": load_identified(self.path, self._described_twin), "after": twin}
        conditions: list[str | None] = [None] if twin.rigid else list(self._conditions)
        rows: dict[str, dict[str, Any]] = {}
        curves: dict[str, dict[str, np.ndarray]] = {}
        for done, condition in enumerate(conditions):
            if condition is not None and not self.tracks.chosen(purpose="fit", condition=condition):
                continue
            for name, model in twins.items():
                progress("report: simulate", done, len(conditions), name)
                made = simulate_runs(self.tracks, model, self.config.tracks, self.config.simulator, condition)
                observations, fields = made.simulation.observations, made.fields()
                for observation, field in zip(observations, fields, strict=True):
                    observed = observation.values_in_world
                    own = curves.setdefault(observation.name, {"times": observation.times, "observed": observed})
                    own[name] = observed + field
                for row in run_errors(observations, fields):
                    error = row.pop("rmse_mm")
                    rows.setdefault(row["run"], row)[f"{name}_mm"] = error
        progress("report: simulate", len(conditions), len(conditions))
        arrays: dict[str, Any] = {f"{key}@{name}": value for name, own in curves.items() for key, value in own.items()}
        write_npz(self.path / "rollout.npz", **arrays)
        errors = list(rows.values())
        write_json(
            self.folder.metrics, {"runs": errors, "unit": "mm", "what": "root mean square distance of the points"}
        )
        files = [self.path / f"{refine_stem(c, self._conditions[0])}.json" for c in self._conditions]
        refined = [with_scopes(read_json(p)) for p in files if p.is_file()]
        write_report(self.folder.report, self.tracks, twin, errors, curves, refined)
        return errors


def refine_stem(condition: str | None, first: str) -> str:
    """Name of the files of ``refine`` without their extension: refine for the ``first`` condition (None: that one),
    refine.CONDITION for another. A condition is any text: what a file name cannot hold is percent-encoded, and so are
    dots, so that no two conditions share a file and none has that of a dry run (refine.CONDITION.dry_run)."""
    if condition is None or condition == first:
        return "refine"
    encoded = quote(condition, safe=" ").replace(".", "%2E")
    return f"refine.{'dry%5Frun' if encoded == 'dry_run' else encoded}"


def law_entry(twin: Twin) -> dict[str, Any]:
    """Kind and parameters of the law; the standard error of one that was given is None."""
    if twin.rigid:
        return {"kind": "rigid", "parameters": {}}
    described = twin.law.description()
    rows = {name: {"stderr": None, **row} for name, row in described["parameters"].items()}
    return {"kind": described["kind"], "parameters": rows}


def _table(rows: list[dict[str, Any]]) -> list[str]:
    """Errors of runs for a terminal."""
    out = []
    for row in rows:
        errors = ", ".join(f"{n.removesuffix('_mm')} {row[n]:.4g} mm" for n in ("before_mm", "after_mm") if n in row)
        out.append(f"  {row['run']:28s} {row['use']:9s} {errors}")
    return out
