"""Memory that a stage will take at its peak, said before it starts. Sizes of arrays follow from the settings; what
processes, libraries and the rest take was measured (benchmarks/memory.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from masiv.config import Config
from masiv.errors import InputError
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.picture_window import MAX_BYTES as WINDOWS_BYTES
from masiv.memory import available_bytes, taken_bytes
from masiv.models.deformable import DeformableBody
from masiv.models.marked_body import MAX_SUBSTEPS
from masiv.mpm.simulator import SUBSTEPS_UNIT, kernels_bytes
from masiv.progress import Progress
from masiv.scene.frame_cache import MAX_BYTES, MAX_BYTES_OF_WORKER
from masiv.scene.scene import Scene
from masiv.workers import process_count

MAIN_MB = {"reconstruct": 530, "trajectory": 600, "identify": 600, "refine": 550}
"""The first process with its libraries and kernels [MB]."""
GRADIENT_PROCESS_MB = 230
"""The second process of reconstruct [MB]."""
SEARCH_PROCESS_MB = 180
"""A further process of identify, without what its simulator reserves [MB]."""
FIT_PROCESS_MB = 290
"""The one that fits a second starting law, without what its simulator reserves [MB]."""
REFINE_PROCESS_MB = 340
"""One that fits effects, without what its simulators reserve [MB]."""
TRACKS_MB = {"identify": 500, "refine": 545}
"""The one process that simulates a body with markers, without what its simulator reserves [MB]."""
FLIGHTS_MB = {"identify": 435, "refine": 475}
"""The one process that solves for bodies in free flight [MB]."""
BYTES_A_PIXEL, BYTES_A_DEPTH = 8, 4
"""Of a picture with its mask, and of its depth."""
BYTES_READ_A_PIXEL = {"reconstruct": 5, "trajectory": 28, "identify": 5}
"""Beside the pictures that are kept, for each pixel of all pictures of one frame: what is made of them together."""


@dataclass(frozen=True)
class MemoryPart:
    """What takes memory: how much [MB], and the setting that makes it less."""

    name: str
    mb: float
    less_with: str


@dataclass(frozen=True)
class ExpectedMemory:
    """The peak of a stage with its processes, by part. A second starting law is counted, which identify may not fit."""

    stage: str
    parts: tuple[MemoryPart, ...]

    @property
    def mb(self) -> float:
        """The whole [MB]."""
        return sum(part.mb for part in self.parts)

    def text(self) -> str:
        """In words, the largest part first."""
        parts = sorted(self.parts, key=lambda part: -part.mb)
        return f"about {_gb(self.mb)} of memory: " + ", ".join(f"{part.name} {_gb(part.mb)}" for part in parts)

    def require(self, limit_mb: float, available_mb: Callable[[], float] | None = None) -> None:
        """Raises InputError if the stage would not fit. limit_mb: what it may take, 0: what the machine has left and
        this process has already. available_mb: says how much that is; None: asks the system."""
        allowed = limit_mb or (available_mb or _available_mb)()
        if self.mb <= allowed:
            return
        reason = "memory_limit_mb allows" if limit_mb else "the machine has left"
        helpful = sorted((part for part in self.parts if part.less_with), key=lambda part: -part.mb)
        less = "; ".join(f"{part.less_with} (now {_gb(part.mb)})" for part in helpful)
        raise InputError(
            f"{self.stage} would take {self.text()}; {reason} {_gb(allowed)}. "
            + (f"To take less: {less}. " if less else "")
            + f"To start it all the same: memory_limit_mb={round(self.mb / 100 + 1) * 100}"
        )

    def announce(self, limit_mb: float, progress: Progress) -> float:
        """Say the whole [MB] before the stage begins, and return it. Raises InputError as ``require``."""
        self.require(limit_mb)
        progress(self.stage, 0, 1, self.text())
        return self.mb


def expected_memory(stage: str, scene: Scene, config: Config, particles: int | None = None) -> ExpectedMemory:
    """Of "reconstruct", "trajectory", "identify" or "refine" of pictures or clouds. scene: what the stage sees.
    particles: of the trajectory, if it is known."""
    count = particles or config.trajectory.particle_count
    if stage == "reconstruct":
        parts = [*_second_process(config), _pictures(stage, scene)]
    elif stage == "trajectory":
        parts = [_pictures(stage, scene)]
    elif stage == "identify":
        parts = [*_identify(config, count, _pictures_of_worker_mb(scene)), _pictures(stage, scene)]
    else:
        parts = _refine(config, count)
    return ExpectedMemory(stage, (MemoryPart("the process", MAIN_MB[stage], ""), *parts))


def expected_tracks_memory(stage: str, config: Config, *, flights: bool) -> ExpectedMemory:
    """Of "identify" or "refine" of tracks. flights: of bodies in free flight, without particles."""
    if flights:
        return ExpectedMemory(stage, (MemoryPart("the process", FLIGHTS_MB[stage], ""),))
    states = _capacity_mb(config.tracks.particles, config, MAX_SUBSTEPS)
    parts = MemoryPart("the process", TRACKS_MB[stage], ""), MemoryPart("states", states, "lower tracks.particles")
    return ExpectedMemory(stage, parts)


def _second_process(config: Config) -> list[MemoryPart]:
    if config.reconstruct.batch_size == 1 or process_count(config.reconstruct.processes) == 1:
        return []
    return [MemoryPart("a second process", GRADIENT_PROCESS_MB, "reconstruct.processes=1")]


def _pictures(stage: str, scene: Scene) -> MemoryPart:
    if scene.load_cloud is not None:
        return MemoryPart("point clouds", 0.0, "")
    every = _all_pictures_bytes(scene)
    kept = min(MAX_BYTES, every) + (min(WINDOWS_BYTES, every) if stage == "identify" else 0)
    return MemoryPart("pictures", (kept + BYTES_READ_A_PIXEL[stage] * _pixels(scene)) / 1e6, "smaller pictures")


def _pixels(scene: Scene) -> int:
    """Of all pictures of one frame."""
    return sum(scene.cameras[view].width * scene.cameras[view].height for view in scene.views)


def _all_pictures_bytes(scene: Scene) -> int:
    """Memory of all pictures of ``scene``, if it were kept."""
    a_pixel = BYTES_A_PIXEL + (BYTES_A_DEPTH if scene.depth_noise is not None else 0)
    return a_pixel * scene.frame_count * _pixels(scene)


def _pictures_of_worker_mb(scene: Scene) -> float:
    """What a further process of identify keeps of pictures and their windows [MB]."""
    every = 0 if scene.load_cloud is not None else _all_pictures_bytes(scene)
    return (min(MAX_BYTES_OF_WORKER, every) + min(WINDOWS_BYTES, every)) / 1e6


def _identify(config: Config, count: int, pictures: float) -> list[MemoryPart]:
    """pictures [MB]: of each process beside the first."""
    identify = config.identify
    if identify.law == "springs":  # its rollouts keep their states elsewhere, within the same bound
        return _simulating(config.simulator.memory_mb, 0.0, "")
    search, whole = (_capacity_mb(n, config) for n in (min(count, identify.search_particles), count))
    processes = 1 if identify.scheduler else process_count(identify.processes)
    phases = _states(identify, processes, search, whole, pictures)
    return _simulating(*max(phases, key=sum), "identify.processes=1")


def _refine(config: Config, count: int) -> list[MemoryPart]:
    """Candidates are fitted with few particles; those that are left are simulated with all, for discretisation."""
    refine = config.refine
    few = _capacity_mb(min(count, refine.particles), config)
    both = few + _capacity_mb(count, config, SUBSTEPS_UNIT)  # finer grids need no adjoint
    processes = 1 if refine.scheduler else process_count(refine.processes)
    if processes == 1:
        return _simulating(few if refine.scheduler else both, 0.0, "")
    return _simulating(few + processes * both, processes * REFINE_PROCESS_MB, "refine.processes=1")


def _simulating(states: float, others: float, less_with: str) -> list[MemoryPart]:
    """states, others [MB]: what simulators reserve, and what processes beside the first take without that."""
    parts = [MemoryPart("states for the adjoint", states, "a lower simulator.memory_mb")]
    return [*parts, MemoryPart("further processes", others, less_with)] if others else parts


def _states(
    identify: IdentifyConfig, processes: int, search: float, whole: float, pictures: float
) -> list[tuple[float, float]]:
    """Of the search for laws with few particles and of the fits with all: what simulators reserve, and what processes
    beside the first take without that [MB]. search, whole: a simulator of few particles, and of all; pictures: of each
    process beside the first."""
    both = whole if whole == search else whole + search  # one process keeps both: Taichi frees nothing
    if identify.law == "neural":
        if identify.scheduler:
            return [(whole, 0.0)]
        if processes > 1:
            searching = processes * search, processes * (SEARCH_PROCESS_MB + pictures)
            return [searching, (2 * whole, FIT_PROCESS_MB + pictures)]
    if identify.law == "auto" and processes > 1:
        return [((processes + 1) * search, processes * (SEARCH_PROCESS_MB + pictures)), (both, 0.0)]
    return [(both, 0.0)]


def _capacity_mb(particles: int, config: Config, substeps: int = DeformableBody.max_substeps) -> float:
    """What a simulator of ``particles`` that keeps ``substeps`` reserves in the memory of the machine; on CUDA it is
    that of the device."""
    if config.arch == "cuda":
        return 0.0
    simulator = config.simulator
    return kernels_bytes(particles, simulator.memory_mb, substeps, simulator.grid_nodes, simulator.chunks) / 1e6


def _available_mb() -> float:
    return (available_bytes() + taken_bytes()) / 1e6


def _gb(mb: float) -> str:
    return f"{mb / 1000:.1f} GB"
