"""A run: its folder, its settings and what was observed. One interface for every kind of observation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from masiv import runtime
from masiv.config import Config, load_config
from masiv.errors import InputError
from masiv.pipeline.requests import Overrides, RefineRequest, SceneRequest, SimulateRequest, Summary, ViewRequest
from masiv.progress import Progress, silent
from masiv.runfolder import Request, RunFolder

if TYPE_CHECKING:
    from masiv.view.subject import Subject


class Run(ABC):
    """The stages of a run folder. A stage runs only if the folder lacks its artefacts; a killed one resumes.

    Subclasses differ in what was observed: pictures (``masiv.pipeline.video``) or tracks (``masiv.pipeline.tracks``).
    The scene is read when a stage needs it. What changes the folder holds its lock; ``simulate`` only reads.
    """

    layouts: ClassVar[str]
    """What the scenes of this kind are made of, for messages."""

    def __init__(self, folder: RunFolder, config: Config, scene: Path) -> None:
        self.folder = folder
        self.config = config
        self.scene_path = scene

    @property
    def path(self) -> Path:
        return self.folder.path

    @abstractmethod
    def request(self) -> Request:
        """What is asked of the run now. Reads the scene. Raises InputError if it is not there or not the run's."""

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Hold the run's lock, and record what is asked of the run now. Raises InputError."""
        request = self.request()
        with self.folder.locked():
            self.folder.accept(request)
            yield

    def existing_scene(self) -> Path:
        """Where the scene is. Raises InputError if it is not there."""
        if not self.scene_path.exists():
            raise InputError(f"the scene of {self.path} is not at {self.scene_path}: say where it is with --scene")
        return self.scene_path

    def start(self) -> None:
        """Start Taichi on the backend that the configuration names."""
        runtime.start(self.config.arch)

    @classmethod
    @abstractmethod
    def open(cls, scene: Path, out: Path, overrides: Overrides, request: SceneRequest) -> Run:
        """The run in ``out``, new or resumed. Everything is checked before the folder is made. Raises InputError."""

    def reconstruct(self, progress: Progress = silent) -> Summary:
        """Dynamic Gaussians. Raises InputError if there are no pictures."""
        raise InputError(f"{self.scene_path} holds {self.layouts}: there is nothing to reconstruct, identify it")

    def trajectory(self, progress: Progress = silent) -> Summary:
        """The filled continuum and its motion. Raises InputError if there are no pictures."""
        raise InputError(f"{self.scene_path} holds {self.layouts}, which are trajectories: identify it")

    @abstractmethod
    def identify(self, progress: Progress = silent) -> Summary:
        """Every stage that the run lacks; then rollout.npz, metrics.json and report.html."""

    @abstractmethod
    def refine(self, request: RefineRequest, progress: Progress = silent) -> Summary:
        """Find the effects that the model lacks: refine.json, the new twin.yaml, the report."""

    @abstractmethod
    def simulate(self, request: SimulateRequest, out: Path, progress: Progress = silent) -> Summary:
        """A rollout under other conditions: ``out``/rollout.npz, and pictures if asked for. Writes nothing else, and
        needs the scene for pictures alone. Raises InputError if ``out`` is a run folder."""

    @abstractmethod
    def evaluate(self, truth: Path | None, progress: Progress = silent) -> Summary:
        """Errors against ground truth or against held-out observations: evaluate.json."""

    @abstractmethod
    def subject(self, request: ViewRequest) -> Subject:
        """What can be shown of the run. Raises InputError."""

    def view(self, request: ViewRequest, ready: Callable[[Summary], None]) -> None:
        """Serve a page that shows the run, until an exception such as Ctrl-C; ``ready`` is told its address. Only
        reads. Raises InputError."""
        runtime.silence()  # Taichi runs in the process that simulates
        from masiv.pipeline.view import view

        view(self, request, ready)


def _kinds() -> dict[str, type[Run]]:
    from masiv.pipeline.tracks import TracksRun
    from masiv.pipeline.video import VideoRun

    return {"tracks": TracksRun, "video": VideoRun}


def open_run(
    scene: Path, out: Path | None = None, overrides: Overrides | None = None, request: SceneRequest | None = None
) -> Run:
    """The run of ``scene`` in the folder ``out`` (runs/SCENE if None), new or resumed. Raises InputError."""
    from masiv.tracks.read import can_read

    kind = _kinds()["tracks" if can_read(scene) else "video"]
    folder = out or Path("runs") / scene.resolve().name
    return kind.open(scene, folder, overrides or Overrides(), request or SceneRequest())


def reopen_run(
    path: Path, overrides: Overrides | None = None, *, scene: Path | None = None, require: str | None = None
) -> Run:
    """The run in the folder ``path``; nothing is written. scene: where the scene is now (None: where it was); require:
    a stage that must be done. Raises InputError."""
    folder = RunFolder.open(path)
    kind = _kinds()["tracks" if folder.record["scene"].get("layout") == "tracks" else "video"]
    config = settings(overrides or Overrides(), folder.config)
    folder.check_settings(config.model_dump(mode="json"))
    if scene is not None and not scene.exists():
        raise InputError(f"--scene {scene} does not exist: give the folder of the run's scene")
    if require is not None:
        folder.require(require)
    return kind(folder, config, scene or folder.scene_path)


def inspect_scene(scene: Path, picture: Path | None = None, overrides: Overrides | None = None) -> Summary:
    """What is read of ``scene``, drawn to ``picture`` (SCENE_inspect.png in the current folder if None)."""
    from masiv.observations.read import read_observation
    from masiv.report.inspection import inspection

    settings(overrides or Overrides(), None)
    target = picture or Path(f"{scene.resolve().stem if scene.is_file() else scene.resolve().name}_inspect.png")
    summary, text = inspection(read_observation(scene), target)
    return Summary(summary, text)


def settings(overrides: Overrides, base: dict[str, Any] | None, **flags: Any) -> Config:
    """The configuration of a run: ``base`` of an existing one, under ``overrides``, under ``flags``."""
    o = overrides
    return load_config(o.preset, o.config, base, o.assignments, seed=o.seed, arch=o.arch, **flags)
