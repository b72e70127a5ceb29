"""The options that every command shares, as typer annotations. Light: no torch, no taichi."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np

    from masiv.pipeline import Overrides

SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of a scene.", show_default=False)]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.", show_default=False)]
MovedSceneOption = Annotated[
    Path | None, typer.Option("--scene", help="Where the run's scene is now. [default: where it was, seen from RUN]")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML with settings; over the preset, under --set and flags.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="One setting, as in reconstruct.iterations=200 (`masiv config` lists them); over --config, under flags; "
        "may be repeated.",
    ),
]
PresetOption = Annotated[str | None, typer.Option("--preset", help="quick, standard or paper. [default: standard]")]
ArchOption = Annotated[str | None, typer.Option("--arch", help="cpu, cuda or vulkan. [default: cpu]")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of every random number. [default: 0]")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else there.")]
FitFramesOption = Annotated[
    int | None, typer.Option("--fit-frames", help="Fit on the first N frames; the rest stays unseen.")
]
HoldoutOption = Annotated[
    list[int] | None, typer.Option("--holdout-camera", help="Keep camera K out of training; may be repeated.")
]
KeepCalibrationOption = Annotated[
    bool, typer.Option("--keep-calibration", help="Keep the cameras as given, instead of refining them.")
]


def overrides(
    preset: str | None, config: Path | None, seed: int | None, arch: str | None, assignments: list[str] | None
) -> Overrides:
    """The settings that a command was given."""
    from masiv.pipeline import Overrides

    return Overrides(preset, config, seed, arch, tuple(assignments or ()))


def vector(text: str | None, flag: str) -> np.ndarray | None:
    """'1,2.5,-3' as an array of three finite numbers. Raises InputError."""
    import math

    import numpy as np

    from masiv.errors import InputError

    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"{flag} {text}: give three finite numbers with commas, for example {flag}=0,-1.5,0")
    return np.array(values)


def numbers(text: str, flag: str, count: int) -> tuple[float, ...]:
    """'0.5,2' as ``count`` finite numbers. Raises InputError."""
    import math

    from masiv.errors import InputError

    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        several = f"{count} finite numbers with commas" if count > 1 else "a finite number"
        raise InputError(f"{flag} {text}: give {several}")
    return values


def pairs(texts: list[str] | None, flag: str, unnamed: str | None = None) -> list[tuple[str, str]]:
    """'NAME=VALUE' as pairs; ``unnamed`` is the name of a value without one. Raises InputError, also for a name that is
    given twice."""
    from masiv.errors import InputError

    found: dict[str, str] = {}
    for text in texts or []:
        name, equals, value = text.partition("=")
        if not equals and unnamed is not None:
            name, value = unnamed, text
        if not value or (not name and unnamed is None):
            raise InputError(f"{flag} {text}: give {flag} NAME=VALUE")
        if name in found:
            raise InputError(f"{flag} is given twice for {name or 'all'}")
        found[name] = value
    return list(found.items())
