"""A run of a scene of pictures: reconstruct -> trajectory -> identify -> refine, simulate, evaluate."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv.config import Config
from masiv.errors import InputError
from masiv.files import write_json
from masiv.hull.first_frame import require_first_frame
from masiv.observations.identity import identity
from masiv.observations.kept_masks import with_kept_masks
from masiv.observations.read import read_scene
from masiv.pipeline import stages
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
from masiv.pipeline.run import Run, reopen_run, settings
from masiv.progress import Progress, silent
from masiv.runfolder import Request, RunFolder, require_folder
from masiv.scene.calibration import Calibration
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.report.viewpoints import View
    from masiv.view.subject import Subject

MIN_SLOW, MAX_SLOW = 0.01, 100.0
"""How many times slower than the motion a video may run: one of a second lasts 10 ms to 100 s."""


class VideoRun(Run):
    """See ``masiv.pipeline.run.Run``. Stages that fit see ``training_scene`` of ``scene``."""

    layouts = "pictures"

    def __init__(self, folder: RunFolder, config: Config, scene: Path, read: Scene | None = None) -> None:
        super().__init__(folder, config, scene)
        self._read = read

    @property
    def scene(self) -> Scene:
        """All frames and cameras; after the reconstruct stage, the cameras that it refined. Raises InputError if the
        scene is not there or not the run's."""
        return stages.calibrated_scene(self.folder, self.given_scene)

    @property
    def given_scene(self) -> Scene:
        """The same with the cameras as they were given."""
        if self._read is None:
            read = read_scene(self.existing_scene())
            self.folder.check_scene(identity(read), self.scene_path)
            self._read = with_kept_masks(read, self.folder.masks)
        return self._read

    def request(self) -> Request:
        split = self.folder.fit_frames, self.folder.holdout_cameras
        return Request(self.config.model_dump(mode="json"), self.scene_path, identity(self.given_scene), *split)

    @classmethod
    def open(cls, scene: Path, out: Path, overrides: Overrides, request: SceneRequest) -> VideoRun:
        existing = RunFolder.begun_in(out)
        flags: dict[str, Any] = {f"identify.{key}": value for key, value in request.identify.items()}
        flags["reconstruct.refine_calibration"] = False if request.keep_calibration else None
        config = settings(overrides, existing.config if existing else None, **flags)
        read = read_scene(scene)
        identified = existing is not None and existing.done("identify")
        for other in () if identified else config.identify.also:
            config.identify.require_neural_for_several()
            if Path(other).resolve() == out.resolve():
                raise InputError(f"--also {other} is the run itself: give runs of other recordings of the same object")
            RunFolder.open(Path(other)).require("trajectory")
        fit_frames = request.fit_frames
        if fit_frames is None:
            fit_frames = existing.fit_frames if existing else read.fit_frames or read.frame_count
        cameras = tuple(sorted(set(request.holdout_camera))) or (existing.holdout_cameras if existing else ())
        visible = read.restricted(fit_frames, cameras)
        if existing is None and not read.masks_estimated:  # those are estimated once, when the folder can keep them
            require_first_frame(visible)
        asked = Request(config.model_dump(mode="json"), scene, identity(read), fit_frames, cameras)
        folder = RunFolder.create_or_resume(out, asked)
        return cls(folder, config, scene, with_kept_masks(read, folder.masks))

    def reconstruct(self, progress: Progress = silent) -> Summary:
        with self.changing():
            dynamic = stages.ensure_gaussians(self.folder, self.config, self.scene, progress)
        from masiv.report.numbers import reconstruction_numbers, table

        numbers = reconstruction_numbers(self.folder, self.scene, dynamic, progress=progress)
        data = {
            "run": str(self.path),
            "gaussians": len(dynamic.canonical),
            "reconstruction": numbers,
            "seconds": self.folder.seconds(),
        }
        text = f"{self.path}: {len(dynamic.canonical)} Gaussians\n"
        if dynamic.calibration is not None:
            data["calibration"] = dynamic.calibration.summary()
            text += f"{dynamic.calibration.text()}\n"
        return Summary(data, f"{text}{table({'reconstruction': numbers})}")

    def trajectory(self, progress: Progress = silent) -> Summary:
        self.start()
        stages.require_memory(self.folder, self.config, self.given_scene, "trajectory")
        with self.changing():
            made = stages.ensure_trajectory(self.folder, self.config, self.scene, progress)
        frames, particles = made.positions.shape[:2]
        data = {
            "run": str(self.path),
            "trajectory": str(self.folder.trajectory),
            "frames": frames,
            "particles": particles,
            "spacing_m": made.spacing,
            "volume_m3": made.volume,
            "seconds": self.folder.seconds(),
        }
        text = f"{self.folder.trajectory}: {particles} particles, {frames} frames, {made.spacing * 1e3:.1f} mm apart"
        data["volume_log_sd"] = made.volume_log_sd if math.isfinite(made.volume_log_sd) else None
        plane = ""
        if made.mirror is not None:
            data["mirror_plane"] = {"normal": made.mirror.normal.tolist(), "offset_m": made.mirror.offset}
            plane = f", {made.mirror}"
        error = "" if math.isnan(made.volume_log_sd) else f" ± {made.volume * made.volume_log_sd * 1e3:.2f}"
        data["problems"] = stages.motion_problems(self.folder, self.scene, made.positions)
        lines = [f"{text}, {made.volume * 1e3:.2f}{error} litres{plane}"]
        return Summary(data, "\n".join([*lines, *problem_lines(data["problems"])]))

    def identify(self, progress: Progress = silent) -> Summary:
        self.start()
        with self.changing():
            return self._identify(progress)

    def _identify(self, progress: Progress) -> Summary:
        from masiv.report.numbers import law_text, material_numbers, run_numbers, table
        from masiv.report.video import write_report
        from masiv.simulation.simulate import simulate

        folder = self.folder
        stages.require_memory(folder, self.config, self.given_scene, "identify")
        dynamic = stages.ensure_gaussians(folder, self.config, self.scene, progress)
        scene = self.scene
        trajectory = stages.ensure_trajectory(folder, self.config, scene, progress)
        twin = stages.ensure_twin(folder, self.config, scene, progress)
        with stages.material_description(folder, self.config, twin):
            rollout = simulate(twin, frames=scene.frame_count, fps=scene.fps, progress=progress)
            rollout.save(folder.rollout)
            numbers = run_numbers(folder, scene, dynamic, trajectory, rollout.positions, progress=progress)
        numbers |= material_numbers(folder)
        write_json(folder.metrics, numbers)
        progress("report", 0, 1)
        write_report(folder, scene, dynamic, trajectory, twin, rollout.positions, numbers)
        progress("report", 1, 1)
        law = twin.law.description()
        data: dict[str, Any] = {"run": str(self.path), "report": str(folder.report), "law": law, "metrics": numbers}
        data["problems"] = stages.motion_problems(folder, scene, trajectory.positions)
        families = twin.fit.get("families", [])
        if families:
            data["families"] = families
        told = "".join(f"{line}\n" for line in problem_lines(data["problems"]))
        return Summary(data, f"{table(numbers)}\n{law_text(law, families)}{told}report   {folder.report}")

    def refine(self, request: RefineRequest, progress: Progress = silent) -> Summary:
        refuse(request, ("group", "condition"), "tracks", self.scene_path)
        self.folder.require("identify")
        runs: list[VideoRun] = [self]
        if request.second_run is not None:
            other = reopen_run(request.second_run, Overrides(arch=self.config.arch), require="trajectory")
            if not isinstance(other, VideoRun):
                raise InputError(
                    f"--second-run {request.second_run} is of a scene of {other.layouts}: give one of pictures"
                )
            runs.append(other)
        self.start()
        from masiv.pipeline.refine_video import refine_runs

        with ExitStack() as changing:
            for run in runs:
                changing.enter_context(run.changing())
            return refine_runs(runs, request, progress)

    def simulate(self, request: SimulateRequest, out: Path, progress: Progress = silent) -> Summary:
        refuse(request, ("condition",), "tracks", self.scene_path)
        self.folder.require("identify")
        require_folder(out, "--out")
        views, cameras, size = self._views(request)
        if request.force is None and (request.force_from is not None or request.force_until is not None):
            raise InputError("--force-from and --force-until need --force FX,FY,FZ")
        if request.blend is not None and request.law is None:
            raise InputError("--blend W needs --law OTHER_RUN, the run whose material is blended in")
        self.start()
        from masiv.pipeline.variation import vary_twin
        from masiv.report.film import film
        from masiv.report.viewpoints import viewpoints
        from masiv.simulation.force import ForcePulse
        from masiv.simulation.simulate import simulate
        from masiv.simulation.twin_effects import body_mass
        from masiv.simulation.variation import without_effects

        force = None
        if request.force is not None:
            until = float("inf") if request.force_until is None else request.force_until
            force = ForcePulse(request.force, request.force_from or 0.0, until)
        twin, gaussians = vary_twin(
            self.folder,
            law=request.law,
            blend=request.blend,
            geometry=request.geometry,
            density=request.density,
            ground=request.ground,
        )
        twin = without_effects(twin, request.without)
        rollout = simulate(
            twin, frames=request.frames, velocity=request.velocity, omega=request.omega,
            gravity=request.gravity, force=force, progress=progress,
        )  # fmt: skip
        out.mkdir(parents=True, exist_ok=True)
        rollout.save(out / "rollout.npz")
        data = {
            "rollout": str(out / "rollout.npz"),
            "frames": request.frames,
            "particles": rollout.positions.shape[1],
            "mass_kg": body_mass(twin),
            "law": twin.law.description(),
            "effects": [effect.name for effect in twin.effects],
        }
        if request.draws:
            film(
                viewpoints(views, cameras, rollout.positions, twin.up, size), gaussians(), rollout.positions, out,
                up=twin.up, ground=twin.ground, fps=twin.fps / (request.slow or 1.0), progress=progress,
            )  # fmt: skip
            data["video"] = str(out / "video.mp4")
        return Summary(data, "\n".join(str(data[name]) for name in ("rollout", "video") if name in data))

    def _views(self, request: SimulateRequest) -> tuple[list[View], tuple[Camera, ...], tuple[int, int] | None]:
        """What is drawn: from where, cameras of the scene, size of the pictures. Raises InputError."""
        from masiv.report.viewpoints import OrbitView, SceneView, parse_size, parse_view, scene_camera

        if not request.draws:
            return [], (), None
        if request.slow is not None and not MIN_SLOW <= request.slow <= MAX_SLOW:
            raise InputError(f"--slow {request.slow:g}: give a factor from {MIN_SLOW:g} to {MAX_SLOW:g}")
        views: list[View] = [parse_view(text) for text in request.camera]
        cameras: tuple[Camera, ...] = ()
        if not views or any(isinstance(view, SceneView) for view in views):
            cameras = self._cameras()
            views = views or [SceneView("0") if cameras else OrbitView()]
        for view in views:
            if isinstance(view, SceneView):
                scene_camera(view, cameras)
        return views, cameras, parse_size(request.size)

    def _cameras(self) -> tuple[Camera, ...]:
        """The scene's cameras, as refined; the scene itself is read only if they were kept as given."""
        calibration = Calibration.load(self.path)
        return self.scene.cameras if calibration is None else calibration.refined

    def subject(self, request: ViewRequest) -> Subject:
        from masiv.pipeline.view import video_subject

        return video_subject(self, request)

    def evaluate(self, truth: Path | None, progress: Progress = silent) -> Summary:
        if truth is None:
            raise InputError("--truth is missing: give the folder with particles_F.npy")
        self.folder.require("trajectory")
        scene = self.scene if self.scene_path.exists() else None
        self.start()
        from masiv.report.numbers import evaluation_numbers, table
        from masiv.report.video import write_report
        from masiv.twin import Twin

        dynamic, trajectory = stages.load_gaussians(self.folder), stages.load_trajectory(self.folder)
        with self.folder.locked():
            twin, rollout = None, None
            if self.folder.done("identify") and self.folder.rollout.is_file():
                twin = Twin.load(self.path)
                rollout = stages.rollout_of(self.folder, twin, progress)
            numbers = evaluation_numbers(
                self.folder, scene, dynamic, trajectory, twin, rollout, truth, progress=progress
            )
            write_json(self.folder.evaluation, numbers)
            metrics = stages.read_metrics(self.folder)
            if scene is not None and twin is not None and rollout is not None and metrics is not None:
                write_report(self.folder, scene, dynamic, trajectory, twin, rollout, metrics)
        text = f"{table(numbers)}\n{self.folder.evaluation}"
        if scene is None:
            text += f"\nno pictures were compared: the scene is not at {self.scene_path}, say where it is with --scene"
        return Summary({"evaluation": str(self.folder.evaluation), **numbers}, text)
