"""What a caller asks of a run. A field that is left out (None, False, empty) is as identified or configured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv.errors import InputError

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Summary:
    """What a pipeline function reports. data: for programs (JSON-able); text: for a person."""

    data: dict[str, Any]
    text: str


def problem_lines(problems: Iterable[str]) -> list[str]:
    """As lines of ``Summary.text``."""
    return [f"problem  {problem}" for problem in problems]


@dataclass(frozen=True)
class Overrides:
    """Settings over those of an existing run, or over the defaults: a preset, a YAML file, a seed, a Taichi backend,
    assignments ("reconstruct.iterations=200")."""

    preset: str | None = None
    config: Path | None = None
    seed: int | None = None
    arch: str | None = None
    assignments: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneRequest:
    """What is read of a scene, and what is fitted to it.

    fit_frames: only the first so many frames are fitted. holdout_camera: indices of cameras that no fit sees.
    identify: keys of that section of the configuration (``law``, ``geometry_loss`` …). no_silhouette: a neural
    law is fitted to geometry alone. keep_calibration: cameras stay as given.
    """

    fit_frames: int | None = None
    holdout_camera: tuple[int, ...] = ()
    identify: Mapping[str, Any] = field(default_factory=dict)
    no_silhouette: bool = False
    keep_calibration: bool = False


@dataclass(frozen=True)
class SimulateRequest:
    """A rollout of a twin under other conditions than those observed.

    velocity (3,) [m/s], omega (3,) [rad/s], gravity (3,) [m/s^2], force (3,) [N] from ``force_from`` to ``force_until``
    [s]: world frame. law: another run, whose material is taken with weight ``blend``. geometry: a mesh, or another
    run. density [kg/m^3]. ground: "none" or a height [m]. without: effects that are left out. condition: of the runs
    whose effects act. render: draw it. camera: from where (``masiv.report.viewpoints.parse_view``; empty: the first
    camera of the scene, or an orbit if it has none). size: of the pictures, "WIDTHxHEIGHT". slow: how many times slower
    than the motion the video runs. Any of these three draws, too.
    """

    frames: int
    velocity: np.ndarray | None = None
    omega: np.ndarray | None = None
    gravity: np.ndarray | None = None
    law: Path | None = None
    blend: float | None = None
    geometry: Path | None = None
    density: float | None = None
    ground: str | None = None
    force: np.ndarray | None = None
    force_from: float | None = None
    force_until: float | None = None
    without: tuple[str, ...] = ()
    condition: str | None = None
    render: bool = False
    camera: tuple[str, ...] = ()
    size: str | None = None
    slow: float | None = None

    @property
    def draws(self) -> bool:
        """Whether pictures are asked for."""
        return self.render or bool(self.camera) or self.size is not None or self.slow is not None


@dataclass(frozen=True)
class ViewRequest:
    """What ``view`` shows, and where. frames: that are simulated (None: those that were observed). law: another run,
    whose law can be taken. condition: of the runs. host, port: of the page."""

    frames: int | None = None
    law: Path | None = None
    condition: str | None = None
    host: str = "127.0.0.1"
    port: int = 8080


@dataclass(frozen=True)
class RefineRequest:
    """What ``refine`` looks at. second_run: another recording of the same object, fitted jointly. group: bodies in
    flight that share physics. condition: of the runs. dry_run: rank the effects, change nothing. relearn: learn the
    neural law anew alongside the effects."""

    second_run: Path | None = None
    group: bool = False
    condition: str | None = None
    dry_run: bool = False
    relearn: bool = False


def refuse(request: object, names: tuple[str, ...], what: str, observed: Path) -> None:
    """Raises InputError if one of ``names`` is given in ``request``: it applies to a scene of ``what`` alone."""
    known = {f.name for f in fields(request)}  # type: ignore[arg-type]
    for name in names:
        value = getattr(request, name) if name in known else getattr(request, "identify", {}).get(name)
        if value is not None and value is not False and (not hasattr(value, "__len__") or len(value)):
            raise InputError(f"--{name.replace('_', '-')} is for scenes of {what}: leave it out for {observed}")
